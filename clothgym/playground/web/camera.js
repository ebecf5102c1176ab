"use strict";
// A page's picture: where a scene is seen from, what fingers and a mouse do to it, and when it is drawn.

const LOWEST = 0.06, HIGHEST = 1.5; // of the eye above the horizon [rad]: never under the floor
const SLOW = 0.045, COARSEST = 0.6; // a frame that takes longer [s] is drawn with fewer pixels from then on, at least that share
const $ = (selector) => document.querySelector(selector);
const CATCH = 44; // how near the cloth a finger takes hold of it [pixels]

// Around a target, by angles, and how fast they turn by themselves after a drag.
class Orbit {
  speed = [0, 0];

  // from where a scene's own camera is, but towards the middle of what happens
  take({ eye, target }, middle) {
    this.own = [{ eye, target }, middle];
    const [x, y, z] = minus(eye, target);
    Object.assign(this, { target: middle, distance: Math.hypot(x, y, z), turn: Math.atan2(y, x), speed: [0, 0] });
    this.rise = Math.min(Math.max(Math.asin(z / this.distance), LOWEST), HIGHEST);
    this.nearest = 0.35 * this.distance;
    this.farthest = 2.5 * this.distance;
  }

  home() {
    this.take(...this.own);
  }

  move(dx, dy) {
    this.turn -= dx;
    this.rise = Math.min(Math.max(this.rise + dy, LOWEST), HIGHEST);
  }

  zoom(factor) {
    this.distance = Math.min(Math.max(this.distance * factor, this.nearest), this.farthest);
  }

  get coasts() {
    return Math.hypot(...this.speed) > 1e-3;
  }

  coast(seconds) {
    this.move(this.speed[0] * seconds, this.speed[1] * seconds);
    this.speed = this.speed.map((value) => value * Math.exp(-5 * seconds));
  }

  get camera() {
    const level = this.distance * Math.cos(this.rise);
    const away = [level * Math.cos(this.turn), level * Math.sin(this.turn), this.distance * Math.sin(this.rise)];
    return { eye: this.target.map((value, c) => value + away[c]), target: this.target };
  }
}

// The particle of a sheet that a place in the picture shows, and its depth; beside the cloth the nearest one, null if none is near.
// at: where a particle is [m]; size: of the picture [pixels].
function caught(viewer, { particles, cells }, at, place, size) {
  const seen = Array.from({ length: particles }, (_, p) => {
    const [across, up, depth] = viewer.toPicture(at(p));
    return [0.5 * (across - place[0]) * size[0], 0.5 * (up - place[1]) * size[1], depth];
  });
  let front = 2, found = null, nearest = CATCH;
  for (let t = 0; t < cells.length; t += 3) {
    const corners = [cells[t], cells[t + 1], cells[t + 2]], [a, b, c] = corners.map((p) => seen[p]);
    const shares = [[b, c], [c, a], [a, b]].map(([p, q]) => p[0] * q[1] - p[1] * q[0]), all = shares[0] + shares[1] + shares[2];
    if (!all || shares.some((share) => share * all < 0)) continue;
    const depth = shares.reduce((sum, share, k) => sum + (share / all) * [a, b, c][k][2], 0);
    if (depth < front) [front, found] = [depth, corners[shares.map(Math.abs).indexOf(Math.max(...shares.map(Math.abs)))]];
  }
  for (let p = 0; front === 2 && p < particles; p++) {
    const away = Math.hypot(seen[p][0], seen[p][1]);
    if (away < nearest) [nearest, found] = [away, p];
  }
  return found === null ? null : { p: found, depth: seen[found][2] };
}

// Fingers and a mouse on a canvas.  grab(place, event) takes hold of the cloth, or returns a falsy value; drag(place) and
// letGo(moved) follow; hover(place) says whether there is cloth; changed() is called when the view has turned.
function watchPointers(canvas, orbit, { grab, drag, letGo, hover, changed }) {
  const fingers = new Map(); // by id, where each is
  const place = (event) => [(2 * event.clientX) / canvas.clientWidth - 1, 1 - (2 * event.clientY) / canvas.clientHeight];
  let holder = null, began = null; // the finger that holds the sheet, and where it began
  const spread = () => {
    const [a, b] = [...fingers.values()];
    return Math.hypot(a[0] - b[0], a[1] - b[1]) || 1;
  };
  const cursor = (name) => (canvas.style.cursor = name);
  canvas.onpointerdown = (event) => {
    canvas.setPointerCapture(event.pointerId);
    cursor("grabbing");
    if (holder === null && fingers.size === 0 && grab(place(event), event)) {
      [holder, began] = [event.pointerId, [event.clientX, event.clientY]];
      return;
    }
    fingers.set(event.pointerId, [event.clientX, event.clientY, event.timeStamp]);
    orbit.speed = [0, 0];
  };
  canvas.onpointermove = (event) => {
    if (event.pointerId === holder) return drag(place(event));
    const before = fingers.get(event.pointerId);
    if (!before) return cursor(hover(place(event)) ? "pointer" : "grab");
    const apart = fingers.size > 1 ? spread() : 0;
    fingers.set(event.pointerId, [event.clientX, event.clientY, event.timeStamp]);
    if (apart) orbit.zoom(apart / spread());
    else {
      const turned = [event.clientX - before[0], event.clientY - before[1]].map((pixels) => (4 * pixels) / Math.min(innerWidth, innerHeight));
      const passed = Math.max(event.timeStamp - before[2], 1) / 1000;
      orbit.move(...turned);
      orbit.speed = turned.map((angle) => Math.min(Math.max(angle / passed, -4), 4));
    }
    changed();
  };
  canvas.onpointerup = canvas.onpointercancel = (event) => {
    cursor("");
    if (event.pointerId === holder) {
      holder = null;
      return letGo(Math.hypot(event.clientX - began[0], event.clientY - began[1]) > 4);
    }
    const before = fingers.get(event.pointerId);
    fingers.delete(event.pointerId);
    // a finger that rested before it was lifted throws nothing
    if (before && event.timeStamp - before[2] > 60) orbit.speed = [0, 0];
    changed();
  };
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    orbit.zoom(Math.exp(0.001 * event.deltaY));
    changed();
  }, { passive: false });
  return { get held() { return fingers.size > 0; } };
}

// What both pages are: a canvas, a viewer and a camera.  A page has advance(seconds, now), free(), slopes, and ready once there is
// something to draw; its own pointers are those of watchPointers().
class Picture {
  constructor(pointers) {
    Object.assign(this, { viewer: new Viewer($("#stage")), orbit: new Orbit(), before: 0, usual: 0, share: 1, stale: true, ready: false });
    const changed = () => (this.stale = true);
    this.fingers = watchPointers($("#stage"), this.orbit, { ...pointers, changed });
    addEventListener("resize", changed);
    $("#home").onclick = () => {
      this.orbit.home();
      changed();
    };
    requestAnimationFrame((now) => this.#tick(now));
  }

  get size() {
    return [$("#stage").clientWidth, $("#stage").clientHeight];
  }

  #tick(now) {
    const seconds = Math.min((now - this.before) / 1000, 0.1);
    this.before = now;
    this.usual += 0.1 * (seconds - this.usual);
    if (this.usual > SLOW && this.share > COARSEST) Object.assign(this, { usual: 0, share: 0.8 * this.share });
    if (this.ready) {
      this.advance(seconds, now);
      if (!this.fingers.held && this.orbit.coasts) {
        this.orbit.coast(seconds);
        this.stale = true;
      }
      if (this.stale) this.draw();
    }
    requestAnimationFrame((then) => this.#tick(then));
  }

  draw() {
    const stage = $("#stage"), scale = this.share * Math.min(devicePixelRatio || 1, 2);
    const [width, height] = this.size.map((pixels) => Math.round(pixels * scale));
    if (stage.width !== width || stage.height !== height) Object.assign(stage, { width, height });
    this.viewer.draw(this.orbit.camera, this.slopes, this.free());
    this.stale = false;
  }
}

function trouble(error) {
  $("#trouble").textContent = error.message;
  $("#trouble").style.display = "grid";
}
