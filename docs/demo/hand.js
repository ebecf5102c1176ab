"use strict";
// A sheet to play with: it moves by itself, see cloth.js, and is drawn as an episode of a single moment that changes.

const HELD_UP = 1.25, SWUNG_OUT = 0.12; // height of the upper hem [m], and its start
const GATHERED = 0.26, GATHERS = 1.2; // how much closer the pins come than the sheet is wide, in sides, so that it falls in folds; in which time [s]
const RIPPLE = 0.004; // of the start: what is flat to the bit folds nowhere [m]
const DROPPED_FROM = 0.72; // height above the floor [m]
const WIND = [0, 3.5, 0.4], GUSTS = 2.5; // [m/s], and the time of one [s]
const HEAVY = 9.81; // [m/s^2]
const MOST_STEPS = 3; // in a frame: what is slower than that runs in slow motion
const SLOW_STEPS = 2; // substeps in a frame of explicit Euler, whose end would be over in one otherwise
const SHOWN = { hang: [[-0.55, -0.4, 0], [0.55, 0.4, 1.3]], drop: [[-0.4, -0.4, 0], [0.4, 0.4, 0.74]] }; // what the picture has to show [m]
const AGAIN_AFTER = 2.5; // a burst [s]

class Hand {
  constructor() {
    Object.assign(this, { start: "hang", fabric: Object.keys(SHEETS.fabrics)[0], windy: false, heavy: true, pinning: false, explicit: false, held: null, left: 0 });
    Object.assign(this, { name: "hand", title: "Hold a sheet", frames: 1, time_step: 1 / 60, duration: Infinity, holes: [], strain_shown: 0.1 });
    this.goal = "Take hold of it, pull, throw. Each step has the bits of the core, computed in your browser.";
    this.camera = { eye: [1.3, -2.2, 1.25], target: [0, 0, 0.6] };
    this.again();
  }

  // Begin again, with the fabric, the start and the switches as they are now.
  again() {
    const data = { ...SHEETS.common, ...SHEETS.fabrics[this.fabric] }, { rows, cols, solids } = data, ball = this.start === "drop" && solids.find(({ plane }) => !plane);
    const cloth = new Cloth({ ...data, solids: ball ? solids : solids.filter(({ plane }) => plane) });
    Object.assign(this, { cloth, held: null, burst: 0, left: 0, shape: [rows, cols], side: data.side, points: rows * cols + (ball ? 1 : 0), ball });
    const x = new Float32Array(3 * cloth.n);
    for (let p = 0; p < cloth.n; p++) {
      // upright and swung out by a little, or flat above the ball
      const across = data.side * ((p % cols) / (cols - 1) - 0.5), along = data.side * (Math.floor(p / cols) / (rows - 1) - 0.5);
      const below = data.side / 2 - along;
      const ripple = RIPPLE * Math.sin(13 * across + 1) * Math.cos(5 * along);
      x.set(ball ? [across, along, DROPPED_FROM + ripple] : [across, SWUNG_OUT * below + ripple, HELD_UP - below], 3 * p);
    }
    cloth.place(x);
    if (!ball) {
      for (const p of [(rows - 1) * cols, rows * cols - 1]) cloth.pin(p, this.#at(p));
    }
    this.solids = ball ? [{ kind: "sphere", holds: true, axes: [1, 0, 0, 0, 1, 0, 0, 0, 1], half: [0, 0, 0], radius: ball.radius, color: [176, 176, 180], shown: [0, 1] }] : [];
    // after this moment come the corners of what the picture has to show
    this.positions = new Float32Array(3 * 3 * this.points);
    this.#write();
    for (let p = 0; p < this.points; p++) {
      SHOWN[this.start].forEach((corner, k) => this.positions.set(corner, 3 * ((k + 1) * this.points + p)));
    }
    this.#switch();
  }

  #switch() {
    const { time_step, substeps, h } = { ...SHEETS.common, ...SHEETS.fabrics[this.fabric] };
    const steps = this.explicit ? SLOW_STEPS : substeps, lasting = this.explicit ? SLOW_STEPS * h : time_step;
    Object.assign(this.cloth, { gravity: [0, 0, this.heavy ? -HEAVY : 0], explicit: this.explicit, substeps: steps, time_step: lasting });
  }

  set(name, value) {
    this[name] = value;
    if (name === "start" || name === "fabric") this.again();
    else this.#switch();
  }

  // The upper corners come closer, unless somebody has taken them.
  #gather() {
    const { pins, rows, cols } = this.cloth, step = (GATHERED * this.time_step) / GATHERS;
    [(rows - 1) * cols, rows * cols - 1].forEach((p, k) => {
      if (!pins.has(p) || this.held?.p === p) return;
      const [x, y, z] = pins.get(p);
      this.cloth.pin(p, [x + (k ? -0.5 : 0.5) * step, y, z]);
    });
  }

  get pins() {
    return [...this.cloth.pins.keys()].map((p) => this.#at(p));
  }

  #at(p) {
    return this.cloth.x.map((row) => row[p]);
  }

  #write() {
    const { cloth, positions } = this;
    for (let c = 0; c < 3; c++) {
      for (let p = 0; p < cloth.n; p++) positions[3 * p + c] = cloth.x[c][p];
    }
    if (this.points > cloth.n) positions.set(this.ball.point, 3 * cloth.n);
  }

  // Take as many steps as have passed.  Returns what there is to tell.
  advance(seconds) {
    if (this.burst > 0) {
      this.burst -= seconds;
      if (this.burst <= 0) {
        this.explicit = false;
        this.again();
      }
      return;
    }
    this.left = Math.min(this.left + seconds, MOST_STEPS * this.time_step);
    for (; this.left >= this.time_step; this.left -= this.time_step) {
      const gust = this.windy ? 0.6 + 0.4 * Math.sin((2 * Math.PI * this.cloth.time) / GUSTS) : 0;
      if (!this.ball && this.cloth.time < GATHERS) this.#gather();
      this.cloth.wind = WIND.map((value) => value * gust);
      this.cloth.step();
    }
    const most = Math.max(...this.cloth.x.map((row) => row.reduce((a, b) => Math.max(a, Math.abs(b)), 0)));
    if (most < 5) this.#write();
    else this.burst = AGAIN_AFTER; // not a number is not less, either
  }

  // The particle that a finger at a place in the picture would take, see camera.js.
  near(viewer, place, size) {
    return caught(viewer, viewer.sheets[0].sheet, (p) => this.#at(p), place, size);
  }

  // Take hold of it.  Returns whether there is one.
  grab(viewer, place, size) {
    const found = this.near(viewer, place, size);
    if (!found) return false;
    this.held = { ...found, pinned: this.cloth.pins.has(found.p) };
    this.cloth.pin(found.p, this.#at(found.p));
    return true;
  }

  // Move what is held to a place in the picture, as far away as it was, and not below the floor.
  drag(viewer, place) {
    const [x, y, z] = viewer.fromPicture([...place, this.held.depth]);
    this.cloth.pin(this.held.p, [x, y, Math.max(z, 0.01)]);
  }

  // Let go; with ``stay`` it stays where it is.
  letGo(stay) {
    if (!stay) this.cloth.release(this.held.p);
    this.held = null;
  }
}
