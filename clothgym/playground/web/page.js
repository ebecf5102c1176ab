"use strict";
// The playground's page: it draws what the server simulates, and tells the server what the visitor does.

const ICONS = { paused: "M4 2l12 7-12 7z", over: "M4 2l12 7-12 7z", playing: "M3 2h4v14H3zM11 2h4v14h-4z" };
const SLOW_FRAMES = 0.05; // of a scene whose frames are so far apart [s], what is between is drawn, too
const TOLD_FOR = 12; // of a message [s]

function made(tag, properties, ...children) {
  const element = Object.assign(document.createElement(tag), properties);
  element.append(...children);
  return element;
}

class Page extends Picture {
  constructor() {
    super({
      grab: (place, { shiftKey }) => this.#grab(place, shiftKey), drag: (place) => (this.dragged = place), letGo: () => this.#letGo(),
      hover: (place) => this.#near(place),
    });
    Object.assign(this, { controls: {}, scene: null, next: null, dragged: null, saving: "" });
    for (const [name, value] of [["play", "play"], ["step", "step"]]) $(`#${name}`).onclick = () => this.turn("play", value);
    $("#again").onclick = () => this.turn("presets", "Start again");
    $("#handle").onclick = () => (this.stale = $("#panel").classList.toggle("open") || true);
    $("#moment").oninput = (event) => this.turn("moment", Number(event.target.value));
    addEventListener("keydown", (event) => {
      if (event.key !== " " || event.target.matches("button, input, select, summary")) return;
      event.preventDefault();
      this.turn("play", "play");
    });
    this.socket = new WebSocket(location.href.replace(/^http/, "ws").replace(/#.*/, ""));
    this.socket.binaryType = "arraybuffer";
    this.socket.onmessage = ({ data }) => {
      if (typeof data !== "string") return this.saving ? this.#save(data) : this.#receive(new Float32Array(data));
      const [[what, content]] = Object.entries(JSON.parse(data));
      this[what](content);
    };
    this.socket.onclose = () => trouble(new Error("The playground has ended, or is full. Reload this page to try again."));
  }

  #grasped; // what the finger holds: its depth in the picture, and where it is [m]

  send(what, value) {
    if (this.socket.readyState === WebSocket.OPEN) this.socket.send(JSON.stringify([what, value]));
  }

  turn(name, value) {
    if (name === "show") this.#color(value);
    this.send("turn", [name, value]);
  }

  // --- what the server tells -------------------------------------------------------------------------------------------

  // Another scene, before its first frame.
  open(scene) {
    this.scene = scene;
    this.viewer.show(scene);
    this.orbit.take(scene.camera, scene.middle);
    Object.assign(this, { next: null, last: null, ready: false, slopes: [scene.slope, scene.slope] });
    $("#labels").replaceChildren(...scene.labels.map((label) => made("span", { textContent: label })));
  }

  solids(solids) {
    solids.forEach((solid) => this.viewer.add(solid));
  }

  look(look) {
    this.viewer.wear(look);
    this.stale = true;
  }

  say([title, words]) {
    const told = made("div", {}, made("b", { textContent: title }), words);
    $("#said").append(told);
    setTimeout(() => told.remove(), 1000 * TOLD_FOR);
  }

  wait(words) {
    $("#wait").textContent = words;
  }

  file(name) {
    this.saving = name;
  }

  #save(content) {
    const url = URL.createObjectURL(new Blob([content]));
    made("a", { href: url, download: this.saving }).click();
    setTimeout(() => URL.revokeObjectURL(url), 10000);
    this.saving = "";
  }

  set(news) {
    for (const [name, properties] of Object.entries(news)) {
      const control = (this.controls[name] ??= { name, ...properties });
      Object.assign(control, properties);
      if (control.kind !== "told") this.#refresh((control.parts ??= this.#build(control)), control, properties);
      else this.#tell(name, control);
    }
  }

  // What is only read.
  #tell(name, { value, high }) {
    if (name === "play" && value) {
      $("#play path").setAttribute("d", ICONS[value]);
      $("#play").setAttribute("aria-label", value === "playing" ? "Pause" : "Play");
    } else if (name === "moment") Object.assign($("#moment"), { max: high, value: value ?? 0 });
    else if (name === "readings") {
      const rows = (value ?? []).map((row) => made("tr", {}, ...row.map((cell) => made("td", { textContent: cell }))));
      ($("#readings") ?? this.#added("Readings", "table", "readings")).replaceChildren(...rows);
    } else if (name === "verdict") this.#judge(value ?? []);
    else if (name === "link") ($("#link") ?? this.#added("Save and share", "input", "link")).value = value ?? "";
    else if ($(`#${name}`)) $(`#${name}`).textContent = value ?? "";
  }

  // The last note: of an evaluation its verdict, and what it says of it.
  #judge(notes) {
    const verdict = $("#verdict"), [subject, words] = notes.at(-1) ?? [];
    verdict.classList.toggle("told", Boolean(subject));
    if (!subject) return;
    const [head, tail] = { burst: ["It has burst", words], evaluation: words.split(": ") }[subject] ?? ["", words];
    verdict.classList.toggle("failed", !/^(Success|You win|A draw)/.test(head));
    verdict.replaceChildren(made("b", { textContent: head }), made("span", { textContent: tail }));
    this.stale = true;
  }

  // --- controls --------------------------------------------------------------------------------------------------------

  #build(control) {
    const { name, kind, label, hint, folder } = control, turn = (value) => this.turn(name, value), parts = { kind };
    if (kind === "chips") {
      parts.row = made("div", { className: "chips" }, ...control.options.map(([value, title]) => made("button", { textContent: title, onclick: () => turn(value) })));
    } else if (kind === "button") {
      const view = () => [this.orbit.camera.eye, this.orbit.camera.target, (360 / Math.PI) * Math.atan(this.scene.slope)];
      parts.input = made("button", { textContent: label, title: hint, onclick: () => turn(name === "save" ? view() : true) });
      parts.row = made("div", { className: "control" }, parts.input);
    } else {
      const text = made("span", { textContent: label });
      parts.input = made(kind === "menu" ? "select" : "input", {});
      if (kind === "menu") parts.input.onchange = () => turn(parts.input.value);
      else if (kind === "switch") Object.assign(parts.input, { type: "checkbox", onchange: () => turn(parts.input.checked) });
      else Object.assign(parts.input, { type: "number", onchange: () => turn(Number(parts.input.value)) });
      parts.row = made("label", { className: "control", title: hint }, text, parts.input);
      if (kind === "slider") {
        parts.range = made("input", { type: "range", ariaLabel: label, oninput: () => turn(Number((parts.input.value = parts.range.value))) });
        parts.row.append(parts.range);
      }
    }
    this.#folder(folder).append(parts.row);
    if (name === "presets") parts.row.after(this.#legend());
    return parts;
  }

  #folder(name) {
    if (!name) return $("#controls");
    const id = `folder-${name.replaceAll(" ", "-")}`;
    const found = document.getElementById(id);
    if (found) return found;
    const folder = made("details", { id }, made("summary", { textContent: name }));
    $("#panel").append(folder);
    return folder;
  }

  #added(folder, tag, id) {
    const element = made(tag, { id, readOnly: true, title: "a link to this page as it is" });
    this.#folder(folder).append(element);
    return element;
  }

  #legend() {
    const bar = made("i", {});
    this.bar = bar;
    return made("div", { id: "legend" }, made("span", { textContent: "at rest" }), bar, made("span", { id: "most" }));
  }

  #refresh({ row, input, range }, control, properties) {
    const { kind, name, value, low, high, step, visible, disabled } = control;
    row.hidden = !visible;
    const folder = row.parentNode;
    if (folder.tagName === "DETAILS") folder.hidden = [...folder.children].slice(1).every((child) => child.hidden);
    if ("options" in properties && kind === "menu") {
      input.replaceChildren(...control.options.map(([own, title]) => made("option", { value: own, textContent: title })));
    }
    for (const part of [input, range]) {
      if (!part || kind === "button") continue;
      if (kind === "slider" || kind === "number") Object.assign(part, { min: low, max: high, step });
      part.disabled = disabled;
      if (kind === "switch") part.checked = value;
      else if (value !== null) part.value = value;
    }
    if (name === "show") this.#color(value);
  }

  #color(by) {
    this.viewer.strained = by === "strain";
    this.stale = true;
  }

  // --- drawing ---------------------------------------------------------------------------------------------------------

  #receive(numbers) {
    if (!this.scene) return;
    const [, count] = numbers, end = 2 + 3 * (this.viewer.sheets.reduce((sum, { sheet }) => sum + sheet.particles, 0) + count), held = [];
    for (let k = end; k < numbers.length; k += 3) held.push([...numbers.subarray(k, k + 3)]);
    const moment = numbers.subarray(2, end), slow = this.scene.time_step > SLOW_FRAMES;
    const from = slow && this.next?.length === moment.length ? this.next : moment;
    Object.assign(this, { last: from, next: moment, held, arrived: performance.now() / 1000, placed: false, ready: true });
  }

  advance(_, now) {
    if (this.dragged && this.#grasped) this.#drag();
    if (this.placed) return;
    const share = this.last === this.next ? 1 : Math.min((now / 1000 - this.arrived) / this.scene.time_step, 1), { last, next } = this;
    this.viewer.place(share < 1 ? next.map((value, k) => last[k] + share * (value - last[k])) : next, this.held);
    Object.assign(this, { placed: share >= 1, stale: true });
  }

  // The panel covers the right, and on a phone the lower part, and there the heading the upper one.
  free() {
    const panel = $("#panel").getBoundingClientRect(), heading = $("#about").getBoundingClientRect();
    if (innerWidth > 640) return [0, 0.97, 0, panel.left / innerWidth];
    return [1 - panel.top / innerHeight, 1 - heading.bottom / innerHeight];
  }

  draw() {
    super.draw();
    this.#label();
    if (this.bar) {
      this.bar.style.background = `linear-gradient(90deg, ${(this.viewer.strained ? HEAT : ["206, 200, 190", ...FIRE]).map((color) => `rgb(${color})`)})`;
      $("#most").textContent = `${+(100 * this.scene.strain_shown).toPrecision(3)} % or more`;
    }
  }

  // Names above the sheets.
  #label() {
    [...$("#labels").children].forEach((label, number) => {
      const { sheet: { positions: x } } = this.viewer.sheets[number];
      let [across, up] = [0, -2];
      for (let v = 0; v < x.length; v += 30) {
        const seen = this.viewer.toPicture(x.subarray(v, v + 3));
        if (seen[1] > up) [across, up] = seen;
      }
      Object.assign(label.style, { left: `clamp(64px, ${50 + 50 * across}%, 100% - 64px)`, top: `calc(${50 - 50 * up}% - 8px)` });
    });
  }

  // --- the visitor's hand ----------------------------------------------------------------------------------------------

  #at(p) {
    return [...this.next.subarray(3 * p, 3 * p + 3)];
  }

  #near(place) {
    // of several sheets the first is the visitor's
    return this.next && caught(this.viewer, this.viewer.sheets[0].sheet, (p) => this.#at(p), place, this.size);
  }

  #grab(place, shift) {
    const found = this.#near(place);
    if (!found) return false;
    this.#grasped = { depth: found.depth, point: this.#at(found.p), shift, moved: false };
    this.send("grasp", ["start", this.#grasped.point]);
    return true;
  }

  // As far away as it was, and no farther aside of the finger than it was at first.
  #drag() {
    const { depth } = this.#grasped;
    this.#grasped.moved = true;
    this.send("grasp", ["update", this.viewer.fromPicture([...this.dragged, depth])]);
    this.dragged = null;
  }

  #letGo() {
    const { point, shift, moved } = this.#grasped;
    this.send("grasp", ["end", point]);
    if (!moved && !this.dragged) this.send("touch", [shift, point, minus(point, this.orbit.camera.eye)]);
    this.dragged = this.#grasped = null;
  }
}

let page;
try {
  page = new Page();
} catch (error) {
  trouble(error);
}
