"use strict";
// Recorded episodes: files that record.py wrote, and where everything is at a moment of one.

const arriving = new Map(); // by name, what takes the text of a file

// called by each file of episodes/
function episodeLoaded(name, text) {
  arriving.get(name)(text);
}

// A script element loads from a disk, too, where fetch() does not.
function loadEpisode(name) {
  const text = new Promise((resolve, reject) => {
    arriving.set(name, resolve);
    const script = document.createElement("script");
    script.src = `episodes/${name}.js`;
    script.onerror = () => reject(new Error(`episodes/${name}.js is missing: make it with  python docs/demo/record.py`));
    document.head.append(script);
  });
  return text.then(unpack);
}

// The format is described in record.py.
async function unpack(text) {
  if (!window.DecompressionStream) throw new Error("This browser is too old for the demo: it cannot unpack gzip.");
  const packed = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("gzip"));
  const content = new Uint8Array(await new Response(stream).arrayBuffer());
  const length = new DataView(content.buffer).getUint32(0, true);
  const episode = JSON.parse(new TextDecoder().decode(content.subarray(4, 4 + length)));
  const { frames, points, quantum, middle } = episode;
  const count = 3 * points, high = content.subarray(4 + length), low = high.subarray(count * frames);
  episode.positions = new Float32Array(count * frames); // [m], frame by frame, point by point
  for (let k = 0; k < count; k++) {
    let value = 0, change = 0;
    for (let frame = 0; frame < frames; frame++) {
      const place = k * frames + frame, zigzag = (high[place] << 8) | low[place];
      change += (zigzag >> 1) ^ -(zigzag & 1);
      value = ((value + change) << 16) >> 16; // modulo 2^16, as it was written
      episode.positions[frame * count + k] = middle[k % 3] + quantum * value;
    }
  }
  episode.duration = (frames - 1) * episode.time_step;
  return episode;
}

// Positions of all points at a time [s], between frames on a smooth curve through them (Catmull and Rom 1974).
function positionsAt(episode, time, out) {
  const { frames, points, positions, time_step: step } = episode;
  const place = Math.min(Math.max(time / step, 0), frames - 1), count = 3 * points;
  const frame = Math.min(Math.floor(place), Math.max(frames - 2, 0)), t = place - frame;
  const row = (k) => count * Math.min(Math.max(k, 0), frames - 1);
  const [a, b, c, d] = [row(frame - 1), row(frame), row(frame + 1), row(frame + 2)];
  const [p, q, r, s] = catmullRom(t);
  for (let k = 0; k < count; k++) {
    out[k] = p * positions[a + k] + q * positions[b + k] + r * positions[c + k] + s * positions[d + k];
  }
  return out;
}

// What happens: every place of the sheet and of what holds it, called with a point [m] and how far it reaches along each axis.
function everywhere({ positions, points, solids, shape }, look, markers) {
  const particles = shape[0] * shape[1], still = [0, 0, 0];
  const reaches = solids.map(({ axes, half, radius }) => still.map((_, c) => radius + half.reduce((sum, h, a) => sum + h * Math.abs(axes[3 * a + c]), 0)));
  for (let k = 0; k < positions.length; k += 3) {
    const solid = (k / 3) % points - particles;
    if (solid >= 0 && !markers && !solids[solid].holds) continue;
    look([positions[k], positions[k + 1], positions[k + 2]], solid < 0 ? still : reaches[solid]);
  }
}

function boundsOf(episode, markers) {
  const low = [1e9, 1e9, 0], high = [-1e9, -1e9, 0];
  everywhere(episode, (point, reach) => {
    for (let c = 0; c < 3; c++) {
      low[c] = Math.min(low[c], point[c] - reach[c]);
      high[c] = Math.max(high[c], point[c] + reach[c]);
    }
  }, markers);
  return { middle: low.map((value, c) => (value + high[c]) / 2), reach: 0.5 * Math.hypot(...minus(high, low)) };
}

// Half the width and half the height of what happens, as seen by a camera, as shares of its distance.
function slopesOf(episode, { eye, target }) {
  const view = lookAt(eye, target, [0, 0, 1]), most = [0, 0];
  everywhere(episode, (point, reach) => {
    for (let corner = 0; corner < 8; corner++) {
      const at = point.map((value, c) => value + ((corner >> c) & 1 ? reach[c] : -reach[c]));
      const seen = [0, 1, 2].map((c) => view[c] * at[0] + view[4 + c] * at[1] + view[8 + c] * at[2] + view[12 + c]);
      for (const c of [0, 1]) most[c] = Math.max(most[c], Math.abs(seen[c] / seen[2]));
      if (reach[0] === 0) break;
    }
  }, false);
  return most.map((slope) => 1.1 * slope);
}

// The frame that is shown at a time.
function frameAt(episode, time) {
  return Math.min(Math.max(Math.round(time / episode.time_step), 0), episode.frames - 1);
}

function isShown(solid, frame) {
  for (let k = 0; k < solid.shown.length; k += 2) {
    if (solid.shown[k] <= frame && frame < solid.shown[k + 1]) return true;
  }
  return false;
}
