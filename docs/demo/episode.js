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

function catmullRom(t) {
  const t2 = t * t, t3 = t2 * t;
  return [(-t + 2 * t2 - t3) / 2, (2 - 5 * t2 + 3 * t3) / 2, (t + 4 * t2 - 3 * t3) / 2, (t3 - t2) / 2];
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
