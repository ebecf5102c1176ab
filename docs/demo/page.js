"use strict";
// The page: which episode is shown, at what time, and from where.

const PAUSE_AT_END = 3.5; // before it starts again [s]
const ICONS = { play: "M4 2l12 7-12 7z", pause: "M3 2h4v14H3zM11 2h4v14h-4z" };
const percent = (share) => `${(100 * Math.max(share, 0)).toFixed(1)} %`;

class Page extends Picture {
  constructor() {
    const hand = (deed) => (...given) => this.episode && this.episode === this.hand && deed(this.hand, ...given);
    super({
      grab: hand((one, place) => one.grab(this.viewer, place, this.size)),
      drag: hand((one, place) => one.held && one.drag(this.viewer, place)),
      letGo: hand((one) => one.held && one.letGo(one.pinning !== one.held.pinned)),
      hover: hand((one, place) => one.near(this.viewer, place, this.size)),
    });
    Object.assign(this, { time: 0, playing: true, waited: 0, loaded: new Map() });
    const heat = `linear-gradient(90deg, ${HEAT.map((color) => `rgb(${color})`)})`;
    $("#scale").style.background = $("#legend div").style.background = heat;
    for (const { name, title } of [{ name: "hand", title: "Hold a sheet" }, ...EPISODES]) {
      const chip = document.createElement("button");
      Object.assign(chip, { textContent: title, onclick: () => this.open(name) });
      chip.dataset.name = name;
      $(".chips").append(chip);
    }
    this.#tools();
    $("#play").onclick = () => this.toggle();
    $("#color").onclick = () => this.colorByStrain(!this.viewer.strained);
    $("#scrubber input").oninput = (event) => this.seek(Number(event.target.value) * this.episode.duration);
    addEventListener("keydown", (event) => this.#key(event));
    addEventListener("hashchange", () => this.open(this.#named()));
    this.open(this.#named());
  }

  #named() {
    const wanted = decodeURIComponent(location.hash.slice(1));
    return EPISODES.some(({ name }) => name === wanted) ? wanted : "hand";
  }

  async open(name) {
    if (this.name === name) return;
    this.name = name;
    $("#trouble").style.display = "";
    for (const chip of $(".chips").children) {
      chip.setAttribute("aria-pressed", chip.dataset.name === name);
      if (chip.dataset.name === name) chip.parentNode.scrollLeft = chip.offsetLeft - chip.parentNode.offsetLeft - 40;
    }
    history.replaceState(null, "", `#${name}`);
    document.body.classList.toggle("live", name === "hand");
    if (name === "hand") return this.#show((this.hand ??= new Hand()));
    try {
      if (!this.loaded.has(name)) this.loaded.set(name, loadEpisode(name));
      const episode = await this.loaded.get(name);
      if (this.name !== name) return; // another was chosen meanwhile
      this.#show(episode);
    } catch (error) {
      trouble(error);
    }
  }

  #show(episode) {
    Object.assign(this, { episode, ready: true });
    const { middle, reach } = boundsOf(episode, true);
    this.moment = new Float32Array(3 * episode.points);
    this.viewer.show(Object.assign(episode, { size: [episode.side, episode.side], middle, reach }));
    this.orbit.take(episode.camera, boundsOf(episode, false).middle);
    this.slopes = slopesOf(episode, this.orbit.camera);
    $("#title").textContent = [episode, ...EPISODES].find(({ name }) => name === this.name).title;
    $("#goal").textContent = episode.goal;
    $("#most").textContent = `${100 * episode.strain_shown} %`;
    if (episode === this.hand) {
      this.time = 0;
      this.#place();
      this.play(true);
      return;
    }
    const most = Math.max(...episode.strain, 1e-6), last = episode.frames - 1;
    const curve = episode.strain.map((value, k) => `L${k / last} ${1 - 0.06 - (0.8 * Math.max(value, 0)) / most}`).join("");
    document.querySelectorAll("#scrubber path").forEach((path) => path.setAttribute("d", `M0 1${curve}L1 1z`));
    this.seek(0);
    this.play(true);
  }

  // Buttons of the sheet that is held: its start, its fabric, and switches.
  #tools() {
    const change = (name, value) => {
      this.hand.set(name, value);
      if (name === "start" || name === "fabric") this.#show(this.hand);
    };
    for (const button of $("#tools").querySelectorAll("button")) {
      const { start, flag } = button.dataset;
      button.onclick = () => change(start ? "start" : flag, start ?? !this.hand[flag]);
    }
    for (const [name, { title }] of Object.entries(SHEETS.fabrics)) $("#fabric").append(new Option(title, name));
    $("#fabric").onchange = (event) => change("fabric", event.target.value);
  }

  // A moment of the sheet that is held.
  #hold(seconds) {
    const { hand } = this;
    hand.advance(seconds);
    if (hand.burst <= 0) {
      this.#place();
      $("#strain b").textContent = percent(Math.max(...this.viewer.sheets[0].sheet.own));
    }
    for (const button of $("#tools").querySelectorAll("[data-flag]")) button.setAttribute("aria-pressed", hand[button.dataset.flag]);
    $("#verdict").classList.toggle("told", hand.burst > 0);
    if (hand.burst > 0) {
      $("#verdict").classList.add("failed");
      $("#verdict").innerHTML = "<b>It has burst</b><span>Explicit Euler gains energy in each step. Semi-implicit Euler does not: it begins again.</span>";
    }
    this.stale = true;
  }

  #place() {
    const { episode, time, moment } = this, frame = frameAt(episode, time), [rows, cols] = episode.shape;
    positionsAt(episode, time, moment);
    episode.solids.forEach((solid, k) => {
      if (!isShown(solid, frame)) moment[3 * (rows * cols + k)] = NaN;
    });
    this.viewer.place(moment, episode.pins ?? []);
  }

  play(on) {
    this.playing = on;
    this.waited = 0;
    this.stale = true;
    $("#play path").setAttribute("d", on ? ICONS.pause : ICONS.play);
    $("#play").setAttribute("aria-label", on ? "Pause" : "Play");
  }

  toggle() {
    if (!this.playing && this.time >= this.episode.duration) this.seek(0);
    this.play(!this.playing);
  }

  colorByStrain(on) {
    this.viewer.strained = on;
    this.stale = true;
    $("#color").setAttribute("aria-pressed", on);
    $("#legend").classList.toggle("shown", on);
  }

  seek(time) {
    this.time = Math.min(Math.max(time, 0), this.episode.duration);
    this.waited = 0;
    this.#place();
    this.stale = true;
    this.#read();
  }

  // What is told beside the picture.
  #read() {
    const { episode, time } = this, frame = frameAt(episode, time), share = time / (episode.duration || 1);
    $("#strain b").textContent = percent(episode.strain[frame]);
    $("#score b").textContent = episode.score[frame].toFixed(2);
    $("#clock").textContent = `${time.toFixed(1)} / ${episode.duration.toFixed(1)} s`;
    $("#scrubber input").value = share;
    $("#scrubber .head").style.left = `${100 * share}%`;
    $("#past rect").setAttribute("width", share);
    const over = frame === episode.frames - 1, verdict = $("#verdict");
    if (over && !verdict.classList.contains("told")) {
      const rate = `${Math.round(100 * episode.success_rate)} % of ${episode.episodes} unseen episodes`;
      verdict.innerHTML = "<b></b><span></span>";
      verdict.firstChild.textContent = `${episode.success ? "Success" : "Not this time"} · score ${episode.score[frame].toFixed(2)}`;
      verdict.lastChild.textContent = `${episode.learner}: succeeds in ${rate}`;
      verdict.classList.toggle("failed", !episode.success);
    }
    verdict.classList.toggle("told", over);
  }

  advance(seconds) {
    if (this.episode === this.hand) this.#hold(seconds);
    else if (this.playing) {
      if (this.time < this.episode.duration) this.seek(this.time + seconds);
      else if ((this.waited += seconds) > PAUSE_AT_END) this.seek(0);
    }
  }

  // The panel covers the lower part, and the heading the upper one, unless the window is so wide that it stands beside the sheet.
  free() {
    const below = 1 - $("#panel").getBoundingClientRect().top / innerHeight;
    const above = innerWidth < 1000 ? $("header > p").getBoundingClientRect().bottom / innerHeight : 0.02;
    return [Math.min(below, 0.5), 1 - Math.min(above, 0.3)];
  }

  #key(event) {
    const step = { ArrowLeft: -1, ArrowRight: 1 }[event.key];
    if (!this.episode || this.episode === this.hand || event.target.matches("button, input, select")) return;
    if (event.key === " ") this.toggle();
    else if (step) {
      this.play(false);
      this.seek(this.time + step * this.episode.time_step);
    } else return;
    event.preventDefault();
  }
}

let page;
try {
  page = new Page();
} catch (error) {
  trouble(error);
}
