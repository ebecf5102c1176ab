"use strict";
// A sheet that moves by itself: the steps of clothgym's core, bit for bit, for a grid of particles with springs, quadratic bending, drag,
// air, pins, and contact of its particles with planes, balls and boxes.  sheet.py writes what it needs of a simulation.
//
// The core computes in float32.  Math.fround rounds each result: for +, -, *, / and the square root of float32 numbers, rounding that of
// float64 gives the same bits (Figueroa 1995).  All sums are in the core's order, which its kernels say in their docstrings.

const f32 = Math.fround;
const TINY = f32(1e-30), TINY_NORMAL = f32(1e-18), TINY_SPEED = f32(1e-12);
const larger = (a, b) => (b > a ? b : a);

class Cloth {
  constructor(data) {
    const { rows, cols } = data, n = rows * cols;
    Object.assign(this, data, { n, time: 0, pins: new Map() });
    for (const name of ["weight", "curve", "shares"]) this[name] = data[name].map((row) => unpacked(row, n));
    this.inverseMass = unpacked(data.inverse_mass, n);
    this.even = unpacked(data.even, n);
    const vector = () => [0, 1, 2].map(() => new Float32Array(n));
    Object.assign(this, { x: vector(), v: vector(), restOfX: vector(), restOfV: vector(), push: vector(), force: vector() });
    this.w = new Float32Array(this.inverseMass);
    // the offset of each kind from a spring's first end to its second, and its forces, with room before for those that have none
    this.offset = data.offset;
    this.before = Math.max(...data.offset);
    this.kinds = this.offset.map(() => [0, 1, 2].map(() => new Float32Array(this.before + n)));
    this.airForce = Array.from({ length: 6 }, () => new Float32Array(n));
    this.gap = new Float32Array(n);
    if (data.positions) this.place(data.positions);
  }

  // At rest at these positions [m], particle by particle.
  place(positions) {
    for (let c = 0; c < 3; c++) {
      for (let p = 0; p < this.n; p++) this.x[c][p] = positions[3 * p + c];
      for (const array of [this.v, this.restOfX, this.restOfV]) array[c].fill(0);
    }
    this.time = 0;
  }

  // Hold particle p, and move it to a target [m] at no more than the pins' speed.
  pin(p, target) {
    this.pins.set(p, target);
    this.w[p] = 0;
  }

  release(p) {
    this.pins.delete(p);
    this.w[p] = this.inverseMass[p];
  }

  // A control step.
  step() {
    for (const [p, target] of this.pins) this.steer(p, target);
    for (let k = 0; k < this.substeps; k++) {
      if (this.air_every > 0 && k % this.air_every === 0) this.blow();
      this.addForces();
      if (this.explicit) this.explicitEuler();
      else this.semiImplicitEuler();
      for (const solid of this.solids) this.resolve(solid);
    }
    this.time += this.time_step;
  }

  // The velocity that takes a pinned particle to its target, or as far as the pins' speed allows.
  steer(p, target) {
    const { x, v } = this, step = f32(this.time_step);
    const [dx, dy, dz] = [0, 1, 2].map((c) => f32(f32(target[c]) - x[c][p]));
    const speed = f32(f32(Math.sqrt(f32(f32(f32(dx * dx) + f32(dy * dy)) + f32(dz * dz)))) / step);
    const slow = f32(1 / f32(larger(f32(speed / f32(this.pin_speed)), 1) * step));
    [v[0][p], v[1][p], v[2][p]] = [dx * slow, dy * slow, dz * slow];
  }

  // Springs and bending, kind by kind, and then their sum for each particle; see clothgym/grid_forces.py.
  addForces() {
    this.offset.forEach((o, a) => (a < this.weight.length ? this.pull(a, o) : this.bend(a, o)));
    const { n, before, kinds } = this, [o0, o1, o2, o3, o4, o5] = this.offset;
    for (let c = 0; c < 3; c++) {
      const [g0, g1, g2, g3, g4, g5] = kinds.map((kind) => kind[c]), push = this.push[c], force = this.force[c];
      for (let p = 0; p < n; p++) {
        const a = before + p;
        let sum = f32(f32(push[p] - g0[a - o0]) + g0[a]);
        sum = f32(f32(sum - g1[a - o1]) + g1[a]);
        sum = f32(f32(sum - g2[a - o2]) + g2[a]);
        sum = f32(f32(sum - g3[a - o3]) + g3[a]);
        sum = f32(f32(sum - g4[a - o4]) + g4[a]);
        force[p] = f32(sum - g5[a - o5]) + g5[a];
      }
    }
  }

  // Springs with bending along the same offset, on their first ends.
  pull(a, o) {
    const [x, y, z] = this.x, [vx, vy, vz] = this.v, [fx, fy, fz] = this.kinds[a], curve = this.curve[a], weight = this.weight[a];
    const tau = f32(this.damping_time), rigidity = f32(this.rigidity), { before } = this, count = this.n - o;
    const stiffness = f32(this.stiffness[a]), rest = f32(this.rest_length[a]);
    for (let p = 0; p < count; p++) {
      const q = p + o, out = before + p, b = f32(curve[p] * rigidity);
      const dx = f32(x[q] - x[p]), dy = f32(y[q] - y[p]), dz = f32(z[q] - z[p]);
      const ux = f32(vx[q] - vx[p]), uy = f32(vy[q] - vy[p]), uz = f32(vz[q] - vz[p]);
      const square = f32(f32(f32(f32(dx * dx) + f32(dy * dy)) + f32(dz * dz)) + TINY);
      const s = f32(1 / f32(Math.sqrt(square)));
      const along = f32(f32(f32(ux * dx) + f32(uy * dy)) + f32(uz * dz));
      const damped = f32(f32(f32(tau * along) * s) * s);
      const g = f32(f32(weight[p] * stiffness) * f32(f32(1 - f32(rest * s)) + damped));
      fx[out] = f32(g * dx) + f32(b * f32(dx + f32(tau * ux)));
      fy[out] = f32(g * dy) + f32(b * f32(dy + f32(tau * uy)));
      fz[out] = f32(g * dz) + f32(b * f32(dz + f32(tau * uz)));
    }
  }

  // Bending along an offset without springs.
  bend(a, o) {
    const curve = this.curve[a], tau = f32(this.damping_time), rigidity = f32(this.rigidity), { before } = this, count = this.n - o;
    for (let c = 0; c < 3; c++) {
      const x = this.x[c], v = this.v[c], force = this.kinds[a][c];
      for (let p = 0; p < count; p++) {
        const d = f32(x[p + o] - x[p]), u = f32(v[p + o] - v[p]);
        force[before + p] = f32(curve[p] * rigidity) * f32(d + f32(tau * u));
      }
    }
  }

  // Velocities, then positions with the new velocities, both with compensated sums; see clothgym/integrators/base.py.
  semiImplicitEuler() {
    const h = f32(this.h), drag = f32(this.drag_rate), share = f32(h / f32(1 + f32(h * drag))), loss = f32(drag * share);
    for (let c = 0; c < 3; c++) {
      this.changeVelocity(c, share, loss);
      this.changePosition(c, h);
    }
  }

  // Positions with the old velocities: it takes energy from nowhere, and bursts.
  explicitEuler() {
    const h = f32(this.h), drag = f32(this.drag_rate), slowed = f32(1 + f32(h * drag));
    for (let c = 0; c < 3; c++) {
      this.changePosition(c, h);
      this.changeVelocity(c, f32(h / slowed), f32(f32(h * drag) / slowed));
    }
  }

  changeVelocity(c, share, loss) {
    const { w, n } = this, v = this.v[c], force = this.force[c], rest = this.restOfV[c], g = f32(this.gravity[c]);
    for (let p = 0; p < n; p++) {
      let change = f32(f32(f32(share * f32(f32(force[p] * w[p]) + g)) - f32(loss * v[p])) + rest[p]);
      if (!(w[p] > 0)) change = 0;
      const now = f32(v[p] + change);
      rest[p] = change - f32(now - v[p]);
      v[p] = now;
    }
  }

  changePosition(c, h) {
    const { n } = this, x = this.x[c], v = this.v[c], rest = this.restOfX[c];
    for (let p = 0; p < n; p++) {
      const change = f32(f32(h * v[p]) + rest[p]), there = f32(x[p] + change);
      rest[p] = change - f32(there - x[p]);
      x[p] = there;
    }
  }

  // The air's force on both triangles of each cell, shared out to its corners; see clothgym/forces.py for the formula.
  blow() {
    const { n, cols, shares, push, airForce } = this, [across, along, density] = this.resistance.map(f32);
    const interval = f32(f32(this.air_every) * f32(this.h));
    const most = f32(f32(this.area) * f32(density / larger(f32(larger(across, along) * interval), TINY)));
    const count = n - cols - 1, difference = f32(across - along);
    // corners a, b in one row and c, d in the next; triangles a, b, d and d, c, a in even cells, a, b, c and d, c, b in others
    this.blowOn(count, 0, 0, [0, 1, cols + 1, cols], along, difference, most);
    this.blowOn(count, 4, 3, [cols + 1, cols, 0, 1], along, difference, most);
    for (let c = 0; c < 3; c++) push[c].fill(0);
    [0, 1, cols, cols + 1].forEach((o, corner) => {
      for (let c = 0; c < 3; c++) {
        const out = push[c], one = airForce[c], two = airForce[3 + c], own = shares[corner], others = shares[4 + corner];
        for (let p = 0; p < count; p++) out[p + o] += f32(f32(own[p] * one[p]) + f32(others[p] * two[p]));
      }
    });
  }

  // On one triangle of each cell, between three particles: to three rows from ``row`` on, with the cells' shares from ``part`` on.
  // The offsets are of its corners from particle p of the cell: the first, the second, and the third in even cells and in others.
  blowOn(count, part, row, [first, second, thirdOfEven, thirdOfOther], along, difference, most) {
    const [x, y, z] = this.x, [vx, vy, vz] = this.v, [wx, wy, wz] = this.wind.map(f32), { cols, even } = this, half = 0.5;
    const [ofA, ofB, ofC, ofD] = this.shares.slice(part, part + 4), [fx, fy, fz] = this.airForce.slice(row, row + 3);
    for (let p = 0; p < count; p++) {
      const i = p + first, j = p + second, k = p + (even[p] > 0 ? thirdOfEven : thirdOfOther), b = p + 1, c = p + cols, d = c + 1;
      const px = f32(x[j] - x[i]), py = f32(y[j] - y[i]), pz = f32(z[j] - z[i]);
      const qx = f32(x[k] - x[i]), qy = f32(y[k] - y[i]), qz = f32(z[k] - z[i]);
      const sa = ofA[p], sb = ofB[p], sc = ofC[p], sd = ofD[p];
      const ux = f32(wx - f32(f32(f32(f32(sa * vx[p]) + f32(sb * vx[b])) + f32(sc * vx[c])) + f32(sd * vx[d])));
      const uy = f32(wy - f32(f32(f32(f32(sa * vy[p]) + f32(sb * vy[b])) + f32(sc * vy[c])) + f32(sd * vy[d])));
      const uz = f32(wz - f32(f32(f32(f32(sa * vz[p]) + f32(sb * vz[b])) + f32(sc * vz[c])) + f32(sd * vz[d])));
      const nx = f32(f32(py * qz) - f32(pz * qy)), ny = f32(f32(pz * qx) - f32(px * qz)), nz = f32(f32(px * qy) - f32(py * qx));
      const twice = f32(Math.sqrt(f32(f32(f32(f32(nx * nx) + f32(ny * ny)) + f32(nz * nz)) + TINY_NORMAL)));
      const fastest = f32(most * f32(1 / f32(half * twice)));
      const length = f32(Math.sqrt(f32(f32(f32(ux * ux) + f32(uy * uy)) + f32(uz * uz)))), speed = fastest < length ? fastest : length;
      const skin = f32(f32(f32(half * speed) * along) * twice);
      const through = f32(f32(f32(ux * nx) + f32(uy * ny)) + f32(uz * nz));
      const face = f32(f32(f32(f32(half * speed) * difference) * through) * f32(1 / twice));
      fx[p] = f32(face * nx) + f32(skin * ux);
      fy[p] = f32(face * ny) + f32(skin * uy);
      fz[p] = f32(face * nz) + f32(skin * uz);
    }
  }

  // Push the particles out of a solid, without inward velocity and with friction; see clothgym/collisions/solids/contact_law.py.
  resolve(solid) {
    const { n, gap } = this, [x, y, z] = this.x, [px, py, pz] = solid.point.map(f32), { plane } = solid;
    const axes = solid.axes.map(f32), radius = f32(solid.radius), reach2 = f32(solid.reach2);
    // heights above a plane, or squared distances beyond the reach; then the particles from the first to the last that are below zero
    let first = n, last = 0;
    for (let p = 0; p < n; p++) {
      const dx = f32(x[p] - px), dy = f32(y[p] - py), dz = f32(z[p] - pz);
      gap[p] = plane
        ? f32(f32(f32(dx * axes[6]) + f32(dy * axes[7])) + f32(dz * axes[8])) - radius
        : f32(f32(f32(dx * dx) + f32(dy * dy)) + f32(dz * dz)) - reach2;
      if (gap[p] < 0) {
        if (first === n) first = p;
        last = p + 1;
      }
    }
    for (let p = first; p < last; p++) {
      if (plane) this.respond(p, gap[p], axes[6], axes[7], axes[8], f32(solid.friction));
      else this.respond(p, ...this.measure(p, solid, axes, radius), f32(solid.friction));
    }
  }

  // Signed distance of a particle from a box that is rounded, as a ball is, and the normal there.
  measure(p, solid, axes, radius) {
    const [dx, dy, dz] = [0, 1, 2].map((c) => f32(this.x[c][p] - f32(solid.point[c])));
    const q = [0, 3, 6].map((a) => f32(f32(f32(dx * axes[a]) + f32(dy * axes[a + 1])) + f32(dz * axes[a + 2])));
    const [ax, ay, az] = q.map((value, c) => f32(Math.abs(value) - f32(solid.half[c])));
    const [ox, oy, oz] = [ax, ay, az].map((value) => larger(value, 0));
    const outside = f32(Math.sqrt(f32(f32(f32(ox * ox) + f32(oy * oy)) + f32(oz * oz)))), deepest = larger(ax, larger(ay, az));
    const beyond = outside > 0, scale = beyond ? f32(1 / outside) : 1;
    const fx = ax >= deepest ? 1 : 0, fy = ay >= deepest && ax < deepest ? 1 : 0, fz = 1 - fx - fy;
    const [nx, ny, nz] = [[ox, fx], [oy, fy], [oz, fz]].map(([o, face], c) => (beyond ? f32(o * scale) : face) * (q[c] >= 0 ? 1 : -1));
    const world = [0, 1, 2].map((c) => f32(f32(f32(nx * axes[c]) + f32(ny * axes[3 + c])) + f32(nz * axes[6 + c])));
    return [f32((beyond ? outside : deepest) - radius), ...world];
  }

  respond(p, distance, nx, ny, nz, friction) {
    const { x, v } = this, lead = this.explicit ? 0 : f32(this.h), touching = distance < 0 && this.w[p] > 0;
    const ux = v[0][p], uy = v[1][p], uz = v[2][p], un = f32(f32(f32(ux * nx) + f32(uy * ny)) + f32(uz * nz));
    const tangent = [f32(ux - f32(un * nx)), f32(uy - f32(un * ny)), f32(uz - f32(un * nz))], [tx, ty, tz] = tangent;
    let inward = larger(-un, 0);
    const speed = f32(f32(Math.sqrt(f32(f32(f32(tx * tx) + f32(ty * ty)) + f32(tz * tz)))) + TINY_SPEED);
    let slowed = f32(f32(friction * inward) / speed);
    slowed = !touching ? 0 : 1 < slowed ? 1 : slowed;
    inward = touching ? inward : 0;
    const depth = touching ? -distance : 0, held = f32(lead * slowed);
    [nx, ny, nz].forEach((normal, c) => {
      x[c][p] += f32(f32(depth * normal) - f32(held * tangent[c]));
      v[c][p] += f32(f32(inward * normal) - f32(slowed * tangent[c]));
    });
  }
}

// Numbers by the index of each in a short list of values, as sheet.py writes them.
function unpacked({ values, index }, count) {
  const list = Float32Array.from(values);
  if (index === undefined) return count > list.length ? new Float32Array(count).fill(list[0]) : list;
  const bytes = Uint8Array.from(atob(index), (letter) => letter.charCodeAt(0));
  return Float32Array.from(bytes, (k) => list[k]);
}

if (typeof module !== "undefined") module.exports = { Cloth };
