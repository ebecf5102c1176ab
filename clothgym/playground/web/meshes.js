"use strict";
// What is drawn: the sheet as a smooth surface through its particles, and solids as boxes swept by a ball.

const REFINED = 4, COARSELY = 2, FINE_SHEET = 25; // drawn cells along the side of a cell, and of one of a sheet with more particles a side
const LIFT = 0.004, DEEPEST = 0.03; // cloth that deep in a solid is drawn above it, at that height [m]

// A sheet of a scene.  A grid (shape: rows and columns, size [m], holes: cells without cloth) is drawn as a bicubic surface through its
// particles, whose corners go on straight beyond the border; any other mesh (triangles, uv [m]) by its own triangles.
class Sheet {
  constructor({ shape, size, holes = [], triangles, uv }) {
    const [rows, cols] = shape ?? [uv.length / 2, 1], refined = !shape ? 1 : rows > FINE_SHEET ? COARSELY : REFINED;
    Object.assign(this, { grid: Boolean(shape), rows, cols, refined, particles: rows * cols });
    Object.assign(this, { fineRows: (rows - 1) * refined + 1, fineCols: (cols - 1) * refined + 1, holes: new Set(holes) });
    const count = this.fineRows * this.fineCols;
    this.positions = new Float32Array(3 * count);
    this.normals = new Float32Array(3 * count);
    this.strain = new Float32Array(count);
    this.own = new Float32Array(rows * cols);
    if (!shape) {
      Object.assign(this, { uv: new Float32Array(uv), triangles: new Uint32Array(triangles), springs: this.#edges(triangles, uv), cells: triangles });
      return;
    }
    this.uv = new Float32Array(2 * count); // from the corner [m]
    this.between = new Float32Array(4 * rows * this.fineCols);
    const spacing = [size[0] / (cols - 1), size[1] / (rows - 1)];
    for (let row = 0, v = 0; row < this.fineRows; row++) {
      for (let col = 0; col < this.fineCols; col++, v++) {
        this.uv[2 * v] = (col / refined) * spacing[0];
        this.uv[2 * v + 1] = (row / refined) * spacing[1];
      }
    }
    this.triangles = this.#triangles(refined);
    this.cells = this.#triangles(1); // between particles
    this.springs = this.#springs(spacing);
    this.weights = Array.from({ length: refined }, (_, k) => catmullRom(k / refined));
  }

  #triangles(refined) {
    const triangles = [], wide = (this.cols - 1) * refined + 1;
    for (let row = 0; row < (this.rows - 1) * refined; row++) {
      for (let col = 0; col < wide - 1; col++) {
        if (this.holes.has(Math.floor(row / refined) * (this.cols - 1) + Math.floor(col / refined))) continue;
        const a = row * wide + col, c = a + wide;
        triangles.push(a, a + 1, c + 1, a, c + 1, c);
      }
    }
    return new Uint32Array(triangles);
  }

  // Edges of triangles, and their length at rest [m].
  #edges(triangles, uv) {
    return triangles.map((i, k) => {
      const j = triangles[k % 3 < 2 ? k + 1 : k - 2];
      return [i, j, Math.hypot(uv[2 * i] - uv[2 * j], uv[2 * i + 1] - uv[2 * j + 1])];
    });
  }

  // Yarns: neighbors in a row or a column, but for those inside a hole, and their length at rest [m].
  #springs([across, along]) {
    const cell = (row, col) => row >= 0 && col >= 0 && row < this.rows - 1 && col < this.cols - 1
      && !this.holes.has(row * (this.cols - 1) + col);
    const springs = [];
    for (let row = 0; row < this.rows; row++) {
      for (let col = 0; col < this.cols; col++) {
        const p = row * this.cols + col;
        if (col + 1 < this.cols && (cell(row, col) || cell(row - 1, col))) springs.push([p, p + 1, across]);
        if (row + 1 < this.rows && (cell(row, col) || cell(row, col - 1))) springs.push([p, p + this.cols, along]);
      }
    }
    return springs;
  }

  // x: positions of the particles [m]; solids: those that the cloth rests on, with their centers.
  place(x, solids) {
    this.#measure(x);
    if (this.grid) this.#refine(x);
    else {
      this.positions.set(x);
      this.strain.set(this.own);
    }
    for (const { solid, center } of solids) this.#pushOut(solid, center);
    turnTriangles(this.positions, this.triangles, this.normals);
  }

  #refine(x) {
    const { rows, cols, refined, fineRows, fineCols } = this;
    // along the rows, then along the columns; the fourth number is the strain
    const coarse = (row, col, c) => (c < 3 ? x[3 * (row * cols + col) + c] : this.own[row * cols + col]);
    const beyond = (k, n, at) => (k < 0 ? 2 * at(0) - at(1) : k >= n ? 2 * at(n - 1) - at(n - 2) : at(k));
    for (let row = 0; row < rows; row++) {
      for (let c = 0; c < 4; c++) {
        const at = (col) => coarse(row, col, c);
        for (let col = 0; col < fineCols; col++) {
          const cell = Math.min(Math.floor(col / refined), cols - 2), k = col - refined * cell;
          const [p, q, r, s] = k < refined ? this.weights[k] : [0, 0, 1, 0];
          this.between[4 * (row * fineCols + col) + c] =
            p * beyond(cell - 1, cols, at) + q * at(cell) + r * at(cell + 1) + s * beyond(cell + 2, cols, at);
        }
      }
    }
    for (let col = 0; col < fineCols; col++) {
      for (let c = 0; c < 4; c++) {
        const at = (row) => this.between[4 * (row * fineCols + col) + c];
        for (let row = 0; row < fineRows; row++) {
          const cell = Math.min(Math.floor(row / refined), rows - 2), k = row - refined * cell;
          const [p, q, r, s] = k < refined ? this.weights[k] : [0, 0, 1, 0];
          const value = p * beyond(cell - 1, rows, at) + q * at(cell) + r * at(cell + 1) + s * beyond(cell + 2, rows, at);
          const v = row * fineCols + col;
          if (c < 3) this.positions[3 * v + c] = value;
          else this.strain[v] = value;
        }
      }
    }
  }

  // The largest strain of the yarns that meet at each particle.
  #measure(x) {
    this.own.fill(-1);
    for (const [i, j, length] of this.springs) {
      const stretched = Math.hypot(x[3 * i] - x[3 * j], x[3 * i + 1] - x[3 * j + 1], x[3 * i + 2] - x[3 * j + 2]) / length - 1;
      this.own[i] = Math.max(this.own[i], stretched);
      this.own[j] = Math.max(this.own[j], stretched);
    }
  }

  // Particles rest on a solid, but the surface between them cuts off its edges.
  #pushOut({ axes, half, radius }, center) {
    const x = this.positions, local = [0, 0, 0], out = [0, 0, 0];
    for (let v = 0; v < x.length; v += 3) {
      let square = 0;
      for (let a = 0; a < 3; a++) {
        local[a] = 0;
        for (let c = 0; c < 3; c++) local[a] += axes[3 * a + c] * (x[v + c] - center[c]);
        out[a] = local[a] - Math.min(Math.max(local[a], -half[a]), half[a]);
        square += out[a] * out[a];
      }
      let length = Math.sqrt(square), distance = length - radius;
      if (length === 0) {
        // inside the box itself: out through the nearest face
        const gaps = local.map((value, a) => half[a] - Math.abs(value)), least = gaps.indexOf(Math.min(...gaps));
        distance = -gaps[least] - radius;
        out[least] = Math.sign(local[least]) || 1;
        length = 1;
      }
      if (distance <= -DEEPEST || distance >= LIFT) continue;
      for (let c = 0; c < 3; c++) {
        for (let a = 0; a < 3; a++) x[v + c] += ((LIFT - distance) / length) * out[a] * axes[3 * a + c];
      }
    }
  }
}

// Normals of vertices, as the triangles around each add up.
function turnTriangles(x, triangles, normals) {
  normals.fill(0);
  for (let t = 0; t < triangles.length; t += 3) {
    const [i, j, k] = [3 * triangles[t], 3 * triangles[t + 1], 3 * triangles[t + 2]];
    const ux = x[j] - x[i], uy = x[j + 1] - x[i + 1], uz = x[j + 2] - x[i + 2];
    const vx = x[k] - x[i], vy = x[k + 1] - x[i + 1], vz = x[k + 2] - x[i + 2];
    const nx = uy * vz - uz * vy, ny = uz * vx - ux * vz, nz = ux * vy - uy * vx;
    for (const v of [i, j, k]) {
      normals[v] += nx;
      normals[v + 1] += ny;
      normals[v + 2] += nz;
    }
  }
}

// Weights of four points in a row for a place between the middle two, 0 to 1 (Catmull and Rom 1974).
function catmullRom(t) {
  const t2 = t * t, t3 = t2 * t;
  return [(-t + 2 * t2 - t3) / 2, (2 - 5 * t2 + 3 * t3) / 2, (t + 4 * t2 - 3 * t3) / 2, (t3 - t2) / 2];
}

const EDGE = 0.008; // radius to which edges of a box are rounded [m]

// The unit sphere cut into octants, which are moved apart: a ball, a capsule or a rounded box around the origin.
function solidMesh({ kind, axes, half, radius }, quarter = 10) {
  if (kind === "box") {
    radius = Math.min(EDGE, 0.25 * Math.min(...half));
    half = half.map((side) => side - radius);
  }
  const angles = Array.from({ length: quarter + 1 }, (_, k) => (k / quarter) * (Math.PI / 2));
  const polar = [...angles, ...angles.map((angle) => angle + Math.PI / 2)];
  const around = [0, 1, 2, 3].flatMap((part) => angles.map((angle) => angle + part * (Math.PI / 2)));
  const signs = [[1, 1], [-1, 1], [-1, -1], [1, -1]];
  const positions = [], normals = [], triangles = [];
  polar.forEach((theta, row) => around.forEach((phi, col) => {
    const normal = [Math.sin(theta) * Math.cos(phi), Math.sin(theta) * Math.sin(phi), Math.cos(theta)];
    const [sx, sy] = signs[Math.floor(col / (quarter + 1))], octant = [sx, sy, row <= quarter ? 1 : -1];
    for (let c = 0; c < 3; c++) {
      let place = 0, turned = 0;
      for (let a = 0; a < 3; a++) {
        place += axes[3 * a + c] * (octant[a] * half[a] + radius * normal[a]);
        turned += axes[3 * a + c] * normal[a];
      }
      positions.push(place);
      normals.push(turned);
    }
  }));
  const columns = around.length, vertex = (row, col) => row * columns + (col % columns);
  for (let row = 0; row + 1 < polar.length; row++) {
    for (let col = 0; col < columns; col++) {
      const [a, b, c, d] = [vertex(row, col), vertex(row, col + 1), vertex(row + 1, col), vertex(row + 1, col + 1)];
      triangles.push(a, c, d, a, d, b);
    }
  }
  // the lids between the octants' poles
  for (const [row, turn] of [[0, 1], [polar.length - 1, -1]]) {
    const corners = [0, 1, 2, 3].map((part) => vertex(row, part * (quarter + 1)));
    const [a, b, c, d] = turn > 0 ? corners : corners.reverse();
    triangles.push(a, b, c, a, c, d);
  }
  return { positions, normals, triangles };
}
