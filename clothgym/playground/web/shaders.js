"use strict";
// Light, floor and fabric, as clothgym's own renderer has them.  Colors are linear until the end of each shader.

const SHADOW_VERTEX = `#version 300 es
layout(location = 0) in vec3 position;
uniform mat4 fromLamp;
uniform vec3 offset;
void main() { gl_Position = fromLamp * vec4(position + offset, 1.0); }`;

const SHADOW_FRAGMENT = `#version 300 es
void main() {}`;

const LIGHT = `#version 300 es
precision highp float;
precision highp sampler2DShadow;
uniform sampler2DShadow shadow;
uniform sampler2D blockers;  // the same, to be read
uniform sampler2D tops;      // depths from straight above
uniform mat4 fromLamp, fromSky;
uniform vec3 lamp;
uniform float reach;         // half the width of both maps [m]
uniform vec4 lampBox, skyBox; // what of each map is not empty: lowest and highest corner
out vec4 color;

const vec3 KEY = vec3(0.90, 0.86, 0.79), SKY = vec3(0.43, 0.43, 0.45), BOUNCE = vec3(0.40, 0.36, 0.32);
const float GOLDEN = 2.39996323;

float noise() { return fract(52.9829189 * fract(dot(gl_FragCoord.xy, vec2(0.06711056, 0.00583715)))); }

vec2 disk(int k, int count, float turn) {
  float angle = float(k) * GOLDEN + 6.2831853 * turn;
  return sqrt((float(k) + 0.5) / float(count)) * vec2(cos(angle), sin(angle));
}

bool outside(vec2 place, vec4 box, float margin) {
  return any(lessThan(place, box.xy - margin)) || any(greaterThan(place, box.zw + margin));
}

// Share of a lamp of some size that reaches a point: the farther away what casts the shadow, the softer (Fernando 2005).
float lit(vec3 point) {
  vec3 place = 0.5 + 0.5 * (fromLamp * vec4(point, 1.0)).xyz;
  float turn = noise(), depth = place.z - 0.0006, sum = 0.0, found = 0.0, wide = 0.06 / (2.0 * reach);
  if (outside(place.xy, lampBox, wide)) return 1.0;
  for (int k = 0; k < 12; k++) {
    float blocker = texture(blockers, place.xy + wide * disk(k, 12, turn)).r;
    if (blocker < depth) { sum += depth - blocker; found += 1.0; }
  }
  if (found == 0.0) return 1.0;
  float size = clamp(0.6 * sum / found, 0.0022 / reach, wide), share = 0.0;
  for (int k = 0; k < 24; k++) share += texture(shadow, vec3(place.xy + size * disk(k, 24, turn), depth));
  return share / 24.0;
}

// Share of the sky that what lies higher around a point takes, 0 to 1.
float roofed(vec3 point, float radius) {
  vec3 place = 0.5 + 0.5 * (fromSky * vec4(point, 1.0)).xyz;
  float turn = noise(), taken = 0.0;
  if (outside(place.xy, skyBox, radius / (2.0 * reach))) return 0.0;
  for (int k = 0; k < 16; k++) {
    vec2 aside = disk(k, 16, turn);
    float top = texture(tops, place.xy + radius / (2.0 * reach) * aside).r;
    float higher = (place.z - top) * 4.0 * reach - 0.004, away = radius * length(aside);
    // what hangs high above takes less
    if (higher > 0.0) taken += higher * inversesqrt(higher * higher + away * away) / (1.0 + 2.2 * higher);
  }
  return taken / 16.0;
}

// Bright light is compressed, as film does it.
vec3 encoded(vec3 light) {
  light = mix(light, 1.0 - 0.3 * exp(-(light - 0.7) / 0.3), step(0.7, light));
  return mix(12.92 * light, 1.055 * pow(max(light, 0.0), vec3(1.0 / 2.4)) - 0.055, step(0.0031308, light));
}

// Share of [q - width / 2, q + width / 2] in which floor(q) is odd.
float stripes(float q, float width) {
  float a = 0.5 * (q - 0.5 * width), b = 0.5 * (q + 0.5 * width);
  return (floor(b) - floor(a) + max(2.0 * fract(b) - 1.0, 0.0) - max(2.0 * fract(a) - 1.0, 0.0)) / width;
}

// Share of [q - width / 2, q + width / 2] that lies within line / 2 of a whole number.
float line(float q, float thick, float width) {
  float a = q - 0.5 * width + 0.5 * thick, b = q + 0.5 * width + 0.5 * thick;
  return ((floor(b) - floor(a)) * thick + min(fract(b), thick) - min(fract(a), thick)) / width;
}
`;

const STUDIO_VERTEX = `#version 300 es
layout(location = 0) in vec2 corner;
uniform mat4 toWorld;
out vec3 far;
void main() {
  vec4 point = toWorld * vec4(corner, 1.0, 1.0);
  far = point.xyz / point.w;
  gl_Position = vec4(corner, 1.0, 1.0);
}`;

const STUDIO_FRAGMENT = LIGHT + `
uniform vec3 eye, middle, FLOOR, LINE, HORIZON, ZENITH;
in vec3 far;
void main() {
  vec3 ray = far - eye;
  float up = ray.z / length(ray.xy);
  if (ray.z >= 0.0) {
    color = vec4(encoded(mix(HORIZON, ZENITH, min(1.5 * up, 1.0))), 1.0);
    return;
  }
  vec3 point = eye + ray * (eye.z / -ray.z);
  point.z = 0.0;
  vec2 tiles = 10.0 * point.xy, wide = max(fwidth(tiles), 1e-4);
  float ink = 1.0 - (1.0 - line(tiles.x, 0.018, wide.x)) * (1.0 - line(tiles.y, 0.018, wide.y));
  float away = clamp((distance(point.xy, middle.xy) / (1.6 * reach) - 0.9) / 3.2, 0.0, 1.0);
  away *= 2.0 - away;
  vec3 light = mix(mix(FLOOR, LINE, ink), HORIZON, away);
  float dark = 1.0 - lit(point);
  light *= (1.0 - vec3(0.50, 0.48, 0.43) * dark) * (1.0 - 0.75 * roofed(point, 0.16));
  color = vec4(encoded(light), 1.0);
}`;

const SURFACE_VERTEX = `#version 300 es
layout(location = 0) in vec3 position;
layout(location = 1) in vec3 normal;
layout(location = 2) in vec2 uv;
layout(location = 3) in float strain;
uniform mat4 toScreen;
uniform vec3 offset;
out vec3 point, turned;
out vec2 cloth;
out float stretched;
void main() {
  point = position + offset;
  turned = normal;
  cloth = uv;
  stretched = strain;
  gl_Position = toScreen * vec4(point, 1.0);
}`;

const SURFACE_FRAGMENT = LIGHT + `
uniform vec3 eye, base, front, back, cream;
uniform vec2 size;            // of the sheet [m]
uniform float check, shown;   // width of a stripe [m]; strain at which the colors end
uniform vec3 heat[13], fire[3];
uniform bool fabric, heated;  // whether strain is all that is colored
in vec3 point, turned;
in vec2 cloth;
in float stretched;

const float TORN = 1.5; // strain of cloth that is not there any more
const float YARNS = 20.0, COARSEST = 0.0024;  // yarns in a stripe, and width of one at most [m]

vec3 hot(float share) {
  float place = 12.0 * clamp(share, 0.0, 1.0);
  int k = min(int(place), 11);
  return mix(heat[k], heat[k + 1], place - float(k));
}

// Gingham as it is woven: stripes of warp cross stripes of weft, and close up yarns lie over and under each other.
vec3 woven(vec3 dye, out float over) {
  float seen = max(fwidth(cloth.x), fwidth(cloth.y)), width = max(seen / check, 1e-5), thread = min(check / YARNS, COARSEST), fine = seen / thread;
  vec2 q = cloth / check, fibers = cloth / thread;
  float warp = stripes(q.x, width), weft = stripes(q.y, width);
  over = 0.5;
  if (fine < 2.0) {
    over += (1.0 - smoothstep(1.0, 2.0, fine)) * 1.4 * (stripes(fibers.x, max(fine, 1e-4)) - 0.5) * (stripes(fibers.y, max(fine, 1e-4)) - 0.5);
  }
  vec3 yarn = mix(dye, mix(dye, cream, 0.6), mix(weft, warp, over));
  return yarn * (1.0 + 0.16 * (over - 0.5));
}

// The hem: cloth turned over and sewn with a line of stitches.
vec3 hemmed(vec3 yarn, float border) {
  float side = max(size.x, size.y), wide = max(fwidth(border), 1e-5), hem = 0.018 * side, thread = 0.0022 * side;
  float folded = smoothstep(hem + wide, hem - wide, border), seam = smoothstep(thread + wide, 0.0, abs(border - hem));
  yarn *= 1.0 - 0.10 * folded - 0.18 * seam;
  float along = min(cloth.x, size.x - cloth.x) < min(cloth.y, size.y - cloth.y) ? cloth.y : cloth.x;
  float stitch = smoothstep(0.30, 0.36, abs(fract(along / (0.02 * side)) - 0.5));
  float sewn = smoothstep(thread + wide, 0.4 * thread, abs(border - 0.72 * hem)) * (1.0 - stitch);
  return mix(yarn, cream, 0.55 * sewn * clamp(1.5 * thread / wide, 0.0, 1.0));
}

// Threads from a quarter of the scale on light up, those that cross only as far as they are seen.
vec3 alight(vec3 own, float share, float over) {
  vec3 glow = share < 0.5 ? mix(fire[0], fire[1], clamp(4.0 * share - 1.0, 0.0, 1.0)) : mix(fire[1], fire[2], clamp(2.0 * share - 1.0, 0.0, 1.0));
  return mix(own, glow, smoothstep(0.2, 0.6, share) * (0.72 + 0.36 * (over - 0.5)));
}

void main() {
  if (fabric ? stretched > TORN : point.z < 0.0) discard;  // what is under the floor is not seen
  vec3 toEye = normalize(eye - point), normal = normalize(turned);
  if (!gl_FrontFacing) normal = -normal;
  float facing = clamp(dot(normal, toEye), 0.0, 1.0), toLamp = dot(normal, lamp);
  // read beside the surface, on its lit side
  float direct = 0.0, through = 0.0, glow = lit(point + (toLamp > 0.0 ? 0.004 : -0.004) * normal);
  direct = max(toLamp, 0.0) * glow;
  float sky = 0.5 + 0.5 * normal.z, taken = roofed(point + 0.006 * normal, 0.14), gloss = 0.0;
  vec3 own = base, rim = vec3(0.35 * pow(1.0 - facing, 3.0));
  if (fabric) {
    float over = 0.5, border = min(min(cloth.x, size.x - cloth.x), min(cloth.y, size.y - cloth.y));
    own = hemmed(woven(gl_FrontFacing ? front : back, over), border);
    own = heated ? hot(stretched / shown) * (0.97 + 0.06 * over) : alight(own, stretched / shown, over);
    direct += 0.30 * max(-toLamp, 0.0) * glow;
  } else {
    vec3 halfway = normalize(lamp + toEye);
    gloss = 0.10 * pow(max(dot(normal, halfway), 0.0), 32.0) * glow;
  }
  float open = 1.0 - 0.85 * taken;
  vec3 light = own * (KEY * direct + SKY * sky * open + BOUNCE * (1.0 - sky) * (0.4 + 0.6 * smoothstep(0.0, 0.25, point.z)));
  color = vec4(encoded(light + SKY * rim * open + gloss), 1.0);
}`;
