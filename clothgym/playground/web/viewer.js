"use strict";
// A small WebGL 2 viewer: sheets, solids, a floor, a lamp.

const SHADOW_SIZE = 2048, TOPS_SIZE = 512;
const SEEN_FROM = { nearest: 0.05, farthest: 60 };
const PIN_RADIUS = 0.009; // of a ball that stands for a held point [m]
const COLORS = {
  front: [206, 64, 50], back: [54, 68, 132], cream: [247, 228, 206], pin: [43, 45, 66],
  FLOOR: [226, 222, 214], LINE: [205, 200, 191], HORIZON: [240, 238, 234], ZENITH: [222, 227, 232],
};
// magma by van der Walt and Smith (2015, CC0), from light to dark without its ends
const HEAT = [
  [252, 240, 178], [254, 211, 149], [254, 182, 124], [253, 152, 105], [249, 121, 93], [239, 93, 94], [220, 72, 105],
  [196, 60, 117], [170, 51, 125], [144, 42, 129], [118, 33, 129], [93, 23, 127], [68, 15, 118],
];
// of threads that light up in the fabric's own colors
const FIRE = [[255, 206, 92], [255, 122, 40], [232, 20, 56]];

const linear = (color) => color.map((c) => (c / 255 <= 0.04045 ? c / 255 / 12.92 : ((c / 255 + 0.055) / 1.055) ** 2.4));

class Viewer {
  constructor(canvas) {
    const gl = canvas.getContext("webgl2", { antialias: true, alpha: false });
    if (!gl) throw new Error("This browser has no WebGL 2, which this page draws with.");
    Object.assign(this, { canvas, gl, sheets: [], solids: [], held: [], strained: false });
    this.shadowing = program(gl, SHADOW_VERTEX, SHADOW_FRAGMENT);
    this.studio = program(gl, STUDIO_VERTEX, STUDIO_FRAGMENT);
    this.surface = program(gl, SURFACE_VERTEX, SURFACE_FRAGMENT);
    this.shadow = depthMap(gl, SHADOW_SIZE);
    this.tops = depthMap(gl, TOPS_SIZE);
    this.comparing = gl.createSampler();
    for (const [name, value] of [
      [gl.TEXTURE_COMPARE_MODE, gl.COMPARE_REF_TO_TEXTURE], [gl.TEXTURE_COMPARE_FUNC, gl.LEQUAL],
      [gl.TEXTURE_MIN_FILTER, gl.LINEAR], [gl.TEXTURE_MAG_FILTER, gl.LINEAR],
      [gl.TEXTURE_WRAP_S, gl.CLAMP_TO_EDGE], [gl.TEXTURE_WRAP_T, gl.CLAMP_TO_EDGE],
    ]) gl.samplerParameteri(this.comparing, name, value);
    this.corners = buffers(gl, [[new Float32Array([-1, -1, 3, -1, -1, 3]), 2]]);
    this.pin = this.#made(solidMesh({ kind: "sphere", axes: [1, 0, 0, 0, 1, 0, 0, 0, 1], half: [0, 0, 0], radius: PIN_RADIUS }, 5));
    gl.enable(gl.DEPTH_TEST);
    gl.depthFunc(gl.LEQUAL);
  }

  #made({ positions, normals, triangles }) {
    return buffers(this.gl, [[new Float32Array(positions), 3], [new Float32Array(normals), 3]], new Uint32Array(triangles));
  }

  // Take up a scene: how many sheets, their mesh (see Sheet), the camera [m], the middle and half the width of what can move [m], and
  // the strain at which the colors of heat end.  What is drawn follows with place().
  show(scene) {
    const gl = this.gl;
    for (const { parts } of [...this.sheets, ...this.solids]) discard(gl, parts);
    this.scene = scene;
    this.sheets = Array.from({ length: scene.sheets ?? 1 }, () => {
      const sheet = new Sheet(scene), { positions, normals, uv, strain, triangles } = sheet;
      return { sheet, parts: buffers(gl, [[positions, 3], [normals, 3], [uv, 2], [strain, 1]], triangles) };
    });
    this.solids = [];
    scene.solids.forEach((solid) => this.add(solid));
    this.wear(scene.look ?? {});
    this.#light();
  }

  // One more solid: a box swept by a ball (axes, a row each, half sides and radius [m]), or a mesh of its own; see solidMesh().
  add(solid) {
    const mesh = solid.positions ? solid : solidMesh(solid, solid.radius > 0 && solid.radius < 0.03 ? 6 : 12);
    this.solids.push({ solid, parts: this.#made(mesh), center: [0, 0, 0], there: false });
  }

  // Colors of both sides of the fabric, and the width of a stripe of its gingham [m].
  wear({ front = COLORS.front, back = COLORS.back, check = Math.max(...this.scene.size) / 12 }) {
    this.look = { front: linear(front), back: linear(back), check };
  }

  // The lamp is high behind the left shoulder of the scene's own camera, and shines on all that ever moves.
  #light() {
    const { camera, middle, reach } = this.scene;
    Object.assign(this, { middle, reach });
    const forward = unit(minus(camera.target, camera.eye)), right = unit(cross(forward, [0, 0, 1])), away = cross(right, [0, 0, 1]);
    const backward = dot(away, forward) > 0 ? away.map((value) => -value) : away;
    this.lamp = unit([0, 1, 2].map((c) => 0.3 * backward[c] - 0.62 * right[c] + (c === 2 ? 1 : 0)));
    const box = (from, up) => multiply(
      orthographic(this.reach), lookAt(this.middle.map((value, c) => value + this.reach * from[c]), this.middle, up));
    this.fromLamp = box(this.lamp, [0, 0, 1]);
    this.fromSky = box([0, 0, 1], [0, 1, 0]);
  }

  // Put everything where it is [m]: the particles of all sheets, and after them the centers of the solids, not a number for one that
  // is not there; held: points of the sheets.
  place(x, held = []) {
    const { gl, sheets } = this;
    let k = 3 * sheets.reduce((sum, { sheet }) => sum + sheet.particles, 0);
    for (const thing of this.solids) {
      thing.there = x[k] === x[k];
      if (thing.there) thing.center = Array.from(x.subarray(k, k + 3));
      k += 3;
    }
    const resting = this.solids.filter(({ solid, there }) => solid.holds && there);
    sheets.forEach(({ sheet, parts }, number) => {
      sheet.place(x.subarray(3 * sheet.particles * number, 3 * sheet.particles * (number + 1)), resting);
      [sheet.positions, sheet.normals, null, sheet.strain].forEach((numbers, k) => {
        if (!numbers) return;
        gl.bindBuffer(gl.ARRAY_BUFFER, parts.made[k]);
        gl.bufferSubData(gl.ARRAY_BUFFER, 0, numbers);
      });
    });
    this.held = held;
    this.lampBox = this.#box(this.fromLamp);
    this.skyBox = this.#box(this.fromSky);
  }

  // What a map shows, from its lowest to its highest corner, in shares of its width.
  #box(m) {
    const box = [1, 1, 0, 0];
    const take = (x, y, z, wide) => {
      for (const c of [0, 1]) {
        const place = 0.5 + 0.5 * (m[c] * x + m[4 + c] * y + m[8 + c] * z + m[12 + c]);
        box[c] = Math.min(box[c], place - wide);
        box[2 + c] = Math.max(box[2 + c], place + wide);
      }
    };
    for (const { sheet: { positions: x } } of this.sheets) {
      for (let v = 0; v < x.length; v += 3) take(x[v], x[v + 1], x[v + 2], 0);
    }
    for (const { solid, center, there } of this.solids) {
      if (there) take(...center, (Math.hypot(...solid.half) + (solid.radius ?? 0)) / (2 * this.reach));
    }
    return box;
  }

  // camera: eye and target [m]; slopes: half the width and height of what has to be in sight, as shares of its distance; free: where,
  // the lower, upper, left and right edge of the part of the picture that nothing covers, as shares of its height and width.
  draw(camera, slopes, free) {
    const { gl, canvas } = this, { toScreen, toWorld } = Object.assign(this, this.#seen(camera, slopes, free));
    gl.enable(gl.POLYGON_OFFSET_FILL);
    gl.polygonOffset(1.5, 2);
    this.#cast(this.shadow, this.fromLamp);
    gl.disable(gl.POLYGON_OFFSET_FILL);
    this.#cast(this.tops, this.fromSky);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.viewport(0, 0, canvas.width, canvas.height);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    for (const [unit, texture, sampler] of [[0, this.shadow, this.comparing], [1, this.shadow, null], [2, this.tops, null]]) {
      gl.activeTexture(gl.TEXTURE0 + unit);
      gl.bindTexture(gl.TEXTURE_2D, texture.depths);
      gl.bindSampler(unit, sampler);
    }
    const common = {
      shadow: 0, blockers: 1, tops: 2, fromLamp: this.fromLamp, fromSky: this.fromSky, lamp: this.lamp, reach: this.reach, lampBox: this.lampBox,
      skyBox: this.skyBox, eye: camera.eye,
    };
    const { cream, FLOOR, LINE, HORIZON, ZENITH } = Object.fromEntries(Object.entries(COLORS).map(([name, color]) => [name, linear(color)]));
    gl.depthMask(false);
    use(gl, this.studio, { ...common, toWorld, middle: this.middle, FLOOR, LINE, HORIZON, ZENITH });
    render(gl, this.corners);
    gl.depthMask(true);
    const zero = [0, 0, 0];
    use(gl, this.surface, {
      ...common, ...this.look, toScreen, offset: zero, fabric: 1, cream, base: zero, size: this.scene.size, shown: this.scene.strain_shown,
      heated: this.strained, heat: HEAT.flatMap(linear), fire: FIRE.flatMap(linear),
    });
    // cloth that lies on something is drawn above it
    gl.enable(gl.POLYGON_OFFSET_FILL);
    gl.polygonOffset(-1, -2);
    for (const { parts } of this.sheets) render(gl, parts);
    gl.disable(gl.POLYGON_OFFSET_FILL);
    for (const { solid, parts, center, there } of this.solids) {
      if (!there) continue;
      use(gl, this.surface, { offset: center, fabric: 0, base: linear(solid.color) });
      render(gl, parts);
    }
    for (const point of this.held) {
      use(gl, this.surface, { offset: point, fabric: 0, base: linear(COLORS.pin) });
      render(gl, this.pin);
    }
  }

  #cast(map, fromLamp) {
    const gl = this.gl;
    gl.bindFramebuffer(gl.FRAMEBUFFER, map.frame);
    gl.viewport(0, 0, map.size, map.size);
    gl.clear(gl.DEPTH_BUFFER_BIT);
    use(gl, this.shadowing, { fromLamp, offset: [0, 0, 0] });
    for (const { parts } of this.sheets) render(gl, parts);
    for (const { parts, center, there } of this.solids) {
      if (!there) continue;
      use(gl, this.shadowing, { offset: center });
      render(gl, parts);
    }
  }

  // Where a point [m] is in the picture, across and up from -1 to 1, and its depth; and the other way round.
  toPicture(point) {
    return through(this.toScreen, point);
  }

  fromPicture(place) {
    return through(this.toWorld, place);
  }

  #seen({ eye, target }, [wide, high], [bottom, top, left = 0, right = 1]) {
    const aspect = this.canvas.width / this.canvas.height, slope = Math.max(high / (top - bottom), wide / (aspect * (right - left)));
    const [aside, shift] = [left + right - 1, bottom + top - 1]; // of the middle
    const { nearest: n, farthest: f } = SEEN_FROM;
    const lens = [1 / (slope * aspect), 0, 0, 0, 0, 1 / slope, 0, 0, -aside, -shift, -(f + n) / (f - n), -1, 0, 0, (-2 * f * n) / (f - n), 0];
    const toScreen = multiply(lens, lookAt(eye, target, [0, 0, 1]));
    return { toScreen, toWorld: inverse(toScreen) };
  }
}

// --- WebGL --------------------------------------------------------------------------------------------------------------

function program(gl, ...sources) {
  const made = gl.createProgram();
  sources.forEach((source, k) => {
    const shader = gl.createShader(k ? gl.FRAGMENT_SHADER : gl.VERTEX_SHADER);
    gl.shaderSource(shader, source);
    gl.compileShader(shader);
    gl.attachShader(made, shader);
    if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS) && !gl.isContextLost()) throw new Error(gl.getShaderInfoLog(shader));
  });
  gl.linkProgram(made);
  if (!gl.getProgramParameter(made, gl.LINK_STATUS) && !gl.isContextLost()) throw new Error(gl.getProgramInfoLog(made));
  const uniforms = new Map();
  for (let k = 0; k < gl.getProgramParameter(made, gl.ACTIVE_UNIFORMS); k++) {
    const { name, type, size } = gl.getActiveUniform(made, k);
    uniforms.set(name.replace("[0]", ""), { place: gl.getUniformLocation(made, name), type, size });
  }
  return { made, uniforms };
}

function use(gl, { made, uniforms }, values) {
  gl.useProgram(made);
  for (const [name, value] of Object.entries(values)) {
    const uniform = uniforms.get(name);
    if (!uniform) continue;
    if (uniform.type === gl.FLOAT_MAT4) gl.uniformMatrix4fv(uniform.place, false, value);
    else if (uniform.type === gl.FLOAT_VEC4) gl.uniform4fv(uniform.place, value);
    else if (uniform.type === gl.FLOAT_VEC3) gl.uniform3fv(uniform.place, value);
    else if (uniform.type === gl.FLOAT_VEC2) gl.uniform2fv(uniform.place, value);
    else if (uniform.type === gl.FLOAT) gl.uniform1f(uniform.place, value);
    else gl.uniform1i(uniform.place, value);
  }
}

function buffers(gl, attributes, triangles = null) {
  const array = gl.createVertexArray(), made = [];
  gl.bindVertexArray(array);
  attributes.forEach(([numbers, size], k) => {
    made.push(gl.createBuffer());
    gl.bindBuffer(gl.ARRAY_BUFFER, made[k]);
    gl.bufferData(gl.ARRAY_BUFFER, numbers, gl.DYNAMIC_DRAW);
    gl.enableVertexAttribArray(k);
    gl.vertexAttribPointer(k, size, gl.FLOAT, false, 0, 0);
  });
  if (triangles) {
    made.push(gl.createBuffer());
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, made.at(-1));
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, triangles, gl.STATIC_DRAW);
  }
  gl.bindVertexArray(null);
  return { array, made, count: triangles ? triangles.length : 3, indexed: Boolean(triangles) };
}

function discard(gl, { array, made }) {
  made.forEach((buffer) => gl.deleteBuffer(buffer));
  gl.deleteVertexArray(array);
}

function render(gl, { array, count, indexed }) {
  gl.bindVertexArray(array);
  if (indexed) gl.drawElements(gl.TRIANGLES, count, gl.UNSIGNED_INT, 0);
  else gl.drawArrays(gl.TRIANGLES, 0, count);
  gl.bindVertexArray(null);
}

function depthMap(gl, size) {
  const depths = gl.createTexture(), frame = gl.createFramebuffer();
  gl.bindTexture(gl.TEXTURE_2D, depths);
  gl.texStorage2D(gl.TEXTURE_2D, 1, gl.DEPTH_COMPONENT24, size, size);
  for (const name of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, name, gl.NEAREST);
  for (const name of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) gl.texParameteri(gl.TEXTURE_2D, name, gl.CLAMP_TO_EDGE);
  gl.bindFramebuffer(gl.FRAMEBUFFER, frame);
  gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.DEPTH_ATTACHMENT, gl.TEXTURE_2D, depths, 0);
  gl.drawBuffers([gl.NONE]);
  gl.bindFramebuffer(gl.FRAMEBUFFER, null);
  return { depths, frame, size };
}

// --- vectors and matrices, column by column -----------------------------------------------------------------------------

const minus = (a, b) => a.map((value, k) => value - b[k]);
const dot = (a, b) => a.reduce((sum, value, k) => sum + value * b[k], 0);
const cross = ([a, b, c], [x, y, z]) => [b * z - c * y, c * x - a * z, a * y - b * x];
const unit = (a) => a.map((value) => value / Math.hypot(...a));

function through(m, [x, y, z]) {
  const [a, b, c, d] = [0, 1, 2, 3].map((k) => m[k] * x + m[4 + k] * y + m[8 + k] * z + m[12 + k]);
  return [a / d, b / d, c / d];
}

function multiply(a, b) {
  return Array.from({ length: 16 }, (_, k) => [0, 1, 2, 3].reduce((sum, j) => sum + a[4 * j + (k % 4)] * b[4 * (k >> 2) + j], 0));
}

function lookAt(eye, target, up) {
  const back = unit(minus(eye, target)), right = unit(cross(up, back)), above = cross(back, right);
  const rows = [right, above, back];
  return [0, 1, 2, 3].flatMap((c) => [...rows.map((row) => (c < 3 ? row[c] : -dot(row, eye))), c < 3 ? 0 : 1]);
}

// A box of half width r in front of the eye, from depth 0 to 4 r.
function orthographic(r) {
  return [1 / r, 0, 0, 0, 0, 1 / r, 0, 0, 0, 0, -0.5 / r, 0, 0, 0, -1, 1];
}

function inverse(m) {
  // Gauss and Jordan with the largest pivot, on rows
  const rows = [0, 1, 2, 3].map((r) => [0, 1, 2, 3].map((c) => m[4 * c + r]).concat([0, 1, 2, 3].map((c) => (c === r ? 1 : 0))));
  for (let k = 0; k < 4; k++) {
    const best = [0, 1, 2, 3].slice(k).reduce((a, b) => (Math.abs(rows[b][k]) > Math.abs(rows[a][k]) ? b : a));
    [rows[k], rows[best]] = [rows[best], rows[k]];
    rows[k] = rows[k].map((value) => value / rows[k][k]);
    for (let r = 0; r < 4; r++) {
      if (r !== k) rows[r] = rows[r].map((value, c) => value - rows[r][k] * rows[k][c]);
    }
  }
  return [0, 1, 2, 3].flatMap((c) => rows.map((row) => row[4 + c]));
}
