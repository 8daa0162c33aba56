// Show one frame as refocused picture, views, slices, spectrum or depth.
import { element, fixed, svg } from "./format.js";
import { Live } from "./live.js";
import { again, ask, place } from "./pictures.js";
import { Refocus, sharpest } from "./refocus.js";

const TABS = ["refocus", "views", "slices", "spectrum", "full", "live", "depth"];
const NOW_AND_THEN = { full: "picture", depth: "depth" };   // tabs of what few frames have in flight, and its name in a frame
const LOOK_MS = 5000;   // the vehicle makes pictures at full size only while it is told that one is looked at
const EARLY_MS = 250;   // views that were made before come sooner, and no other picture flashes before them
const $ = (id) => document.getElementById(id);

export class Stage {
  constructor() {
    this.tab = "refocus";
    this.frame = null;     // {tag, slices, thumb, depth, picture}
    this.newest = {};      // where the newest frame is followed: the newest that has a picture, and that has a depth
    this.live = new Live($("live"));
    this.layout = null;
    this.bitmap = null;
    this.looks = false;    // whether the vehicle is told so
    this.turn = 0;         // number of the request: an older answer that comes late is ignored
    try {
      this.refocus = new Refocus($("gl"));
      $("gl").addEventListener("webglcontextlost", (event) => { event.preventDefault(); this.refocus = null; this.load(); });
    } catch {
      this.refocus = null;   // the server makes the picture instead
    }
    for (const name of TABS) $(`tab-${name}`).addEventListener("click", () => this.choose(name));
    document.querySelector(".tabs").addEventListener("keydown", (event) => this.arrow(event));
    $("disparity").addEventListener("input", () => this.draw());
    $("autofocus").addEventListener("click", () => this.focusAt(0.5, 0.5));
    for (const id of ["gl", "picture"]) $(id).addEventListener("click", (event) => {
      const box = event.currentTarget.getBoundingClientRect();
      this.focusAt((event.clientX - box.left) / box.width, (event.clientY - box.top) / box.height);
    });
    new ResizeObserver(() => this.size()).observe($("frame-box"));
    this.tabs();
  }

  set(frame, newest) {
    const { tab, shown } = this;
    Object.assign(this, { frame, newest });
    this.tabs();   // a depth or a picture that has come, or is no longer there
    const now = this.shown, same = shown && now && shown.tag.frame === now.tag.frame && shown.tag.flight === now.tag.flight;
    const ready = same && this.aspect && Boolean(shown.thumb) === Boolean(now.thumb);
    if (!ready || this.tab !== tab) this.load();
  }

  // The frame that the tab shows.
  get shown() {
    return this.of(this.tab);
  }

  of(tab) {
    const part = NOW_AND_THEN[tab];
    return !part || this.frame?.[part] ? this.frame : this.newest[part] ?? null;
  }

  // Whether there is something to show. The newest frames get pictures at full size once the tab is open.
  offers(tab) {
    const follows = "picture" in this.newest, { slices, tag } = this.frame ?? {};
    return Boolean(this.of(tab)) || tab === "full" && follows && Boolean(slices) && tag.mask !== "lenslet";
  }

  choose(name) {
    this.tab = name;
    this.tabs();
    this.load();
  }

  arrow(event) {
    const step = { ArrowRight: 1, ArrowLeft: -1 }[event.key];
    if (!step) return;
    const open = TABS.filter((name) => !$(`tab-${name}`).hidden);
    const next = open[(open.indexOf(this.tab) + step + open.length) % open.length];
    this.choose(next);
    $(`tab-${next}`).focus();
  }

  tabs() {
    for (const tab of Object.keys(NOW_AND_THEN)) {
      show($(`tab-${tab}`), this.offers(tab));
      if (this.tab === tab && !this.offers(tab)) this.tab = "refocus";
    }
    for (const name of TABS) {
      const chosen = name === this.tab;
      $(`tab-${name}`).setAttribute("aria-selected", String(chosen));
      $(`tab-${name}`).tabIndex = chosen ? 0 : -1;
    }
    $("panel").setAttribute("aria-labelledby", `tab-${this.tab}`);
    this.showSlider();
  }

  // Show the slider only for a frame with views.
  showSlider() {
    $("focus").toggleAttribute("data-off", this.tab !== "refocus" || !this.layout);
  }

  async load() {
    const turn = ++this.turn, { shown: frame, tab } = this;
    if (tab === "live") { this.watch(); return; }
    if ($("live").hasAttribute("data-on")) this.leave();
    $("frame-box").toggleAttribute("data-full", false);
    if (tab === "full") this.look();
    if (!frame && tab === "full") this.nothing("Pictures at full size are made while this tab is open: the newest frame gets one.");
    if (!frame) return;
    const index = frame.tag.frame, base = `/api/frames/${index}/`;
    const name = `frame ${index}${frame === this.frame ? "" : ", the newest that has one"}`;
    $("which").textContent = `${name} …`;   // loading: the frame before is still shown
    $("empty").textContent = `Waiting for the picture of frame ${index}.`;
    try {
      if (tab === "refocus") await this.loadViews(base, turn);
      else if (tab === "full") await this.loadFull(base, turn);
      else await this.loadPicture(`${base}${{ views: "views.jpg", slices: "slices.jpg", spectrum: "spectrum.jpg", depth: "depth.png" }[tab]}`, tab, turn);
    } catch (error) {
      if (turn === this.turn) await this.fall(base, turn, error.message);
    }
    if (turn === this.turn) $("which").textContent = name;
  }

  async look() {
    if (this.looks) return;
    this.looks = true;
    await again(LOOK_MS, () => this.tab === "full" && !document.body.hasAttribute("data-recording"), async () => {
      try {
        await fetch("/api/full", { method: "POST", headers: { "content-type": "application/json" }, body: "{}", signal: AbortSignal.timeout(LOOK_MS) });
      } catch { /* no connection: said again */ }
    });
    this.looks = false;
  }

  watch() {
    for (const id of ["gl", "picture", "overlay"]) show($(id), false);
    $("which").textContent = "live view";
    if ($("live").hasAttribute("data-on")) return;
    $("live").setAttribute("data-on", "");
    this.noLive("Waiting for the camera's picture.");
    this.live.run(
      () => this.tab === "live",
      ({ aspect, sharpness, clipped, closer }) => {
        this.aspect = aspect;
        this.size();
        show($("live"), true);
        show($("empty"), false);
        $("which").textContent = `sharpness ${Math.round(100 * sharpness)} % of the best, ${clipped < 0.0005 ? "< 0.1" : fixed(100 * clipped, 1)} % clipped`;
        $("caption").textContent = `Turn the focus ring until the sharpness of the ${closer ? "part that you see" : "middle"} rises no more. Tap to ${closer ? "see all" : "look closer"}. Leave this tab before take-off: a shot has to wait until live view has ended.`;
      },
      (why) => this.noLive(why),
    );
  }

  noLive(why) {
    $("which").textContent = "live view";
    show($("live"), false);
    show($("empty"), true);
    $("empty").textContent = why;
    $("caption").textContent = "";
  }

  leave() {
    $("live").removeAttribute("data-on");
    show($("live"), false);
    this.aspect = null;
    if (this.frame) return;
    show($("empty"), true);
    $("which").textContent = "no frame";
    $("caption").textContent = "";
    $("empty").textContent = "The first frame will appear here.";
  }

  // Without views, show the mean picture.
  async fall(base, turn, why) {
    if (this.tab === "refocus") {
      this.layout = this.bitmap = null;
      this.showSlider();
      try {
        await this.loadPicture(`${base}mean.jpg`, "mean", turn);
        if (turn === this.turn) $("caption").textContent = `The mean picture. ${why}`;
        return;
      } catch { /* not decoded at all: the sentence stands alone */ }
    }
    if (turn === this.turn) this.nothing(why);
  }

  nothing(why) {
    for (const id of ["gl", "picture", "overlay"]) show($(id), false);
    show($("empty"), true);
    $("empty").textContent = why;
    $("caption").textContent = "";
  }

  // Views take seconds to make: until they are there, the mean picture is shown.
  async loadViews(base, turn) {
    let isMade = false;
    const early = setTimeout(() => this.showMean(base, turn, () => turn === this.turn && !isMade), EARLY_MS);
    try {
      await this.makeViews(base, turn, () => { isMade = true; });
    } finally {
      clearTimeout(early);
      isMade = true;
    }
  }

  // One pixel of the sensor on one of the page; the middle first, the rest by scrolling.
  async loadFull(base, turn) {
    if (!await this.loadPicture(`${base}full.jpg`, "full", turn)) return;
    const box = $("frame-box"), picture = $("picture");
    box.toggleAttribute("data-full", true);
    box.scrollTo((picture.naturalWidth - box.clientWidth) / 2, (picture.naturalHeight - box.clientHeight) / 2);
    const facts = await ask(`${base}full.json`, { read: (answer) => answer.json(), wanted: () => turn === this.turn, first: true });
    if (!facts || turn !== this.turn) return;
    const words = `${picture.naturalWidth} × ${picture.naturalHeight} px without the mask's shadow, one for one: scroll.`;
    $("caption").textContent = [words, ...facts.doubts.map((one) => `In doubt: ${one}.`)].join(" ");
  }

  async showMean(base, turn, wanted) {
    try {
      if (await this.loadPicture(`${base}mean.jpg`, "mean", turn, wanted)) {
        this.layout = this.bitmap = null;
        this.showSlider();
        $("caption").textContent = "The mean picture. Its views are being made.";
      }
    } catch { /* the views' own answer says why */ }
  }

  async makeViews(base, turn, made) {
    const wanted = () => turn === this.turn;
    const layout = await ask(`${base}views.json`, { read: (answer) => answer.json(), wanted, first: true });
    if (!layout) return;
    const drawn = this.refocus && this.refocus.fits(layout);
    let bitmap = null;
    if (drawn) {
      const blob = await ask(`${base}views.jpg`, { wanted, first: true });
      if (!blob) return;
      bitmap = await createImageBitmap(blob, { colorSpaceConversion: "none", premultiplyAlpha: "none" });
    }
    if (turn !== this.turn) return;
    made();
    this.layout = layout;
    this.bitmap = bitmap;
    this.showSlider();
    this.aspect = layout.tile[1] / layout.tile[0];
    show($("empty"), false);
    show($("overlay"), false);
    if (drawn) {
      this.refocus.show(layout, bitmap);
      show($("picture"), false);
      show($("gl"), true);
      $("caption").textContent = `${layout.row_steps.length} × ${layout.column_steps.length} views of ${layout.tile[1]} × ${layout.tile[0]} px, made quickly, phases from the ${layout.source}. Tap a place to focus on it.`;
    } else {
      show($("gl"), false);
      $("caption").textContent = `${layout.row_steps.length} × ${layout.column_steps.length} views, made quickly, phases from the ${layout.source}. This browser has no WebGL2: the vehicle makes the picture.`;
    }
    this.size();
    this.draw();
  }

  // Whether it is shown: not where it is no longer `wanted` by then.
  async loadPicture(url, kind, turn, wanted = () => turn === this.turn) {
    const blob = await ask(url, { wanted, first: true });
    if (!blob || !wanted()) return false;
    const picture = $("picture");
    await place(picture, blob);
    if (!wanted()) return false;
    picture.dataset.kind = kind;
    picture.alt = `${kind} of frame ${this.shown.tag.frame}`;
    show(picture, true);
    show($("gl"), false);
    show($("empty"), false);
    this.aspect = picture.naturalWidth / picture.naturalHeight;
    this.size();
    this.overlay(kind);
    return true;
  }

  draw() {
    const disparity = Number($("disparity").value);
    const share = this.layout?.aperture ? disparity / this.layout.aperture : 1;   // Eq 28: 1 − 1/α of the aperture
    const alpha = share < 1 ? `, α ${fixed(1 / (1 - share), 4)}` : "";
    $("disparity-text").textContent = `${disparity > 0 ? "+" : ""}${fixed(disparity, 2)} px${alpha}`;
    if (this.tab !== "refocus" || !this.layout) return;
    if (this.bitmap && this.refocus) this.refocus.draw(disparity);
    else this.ask(disparity);
  }

  // Without WebGL: one picture at a time, then the newest position of the slider.
  async ask(disparity) {
    this.wanted = disparity;
    if (this.asking) return;
    this.asking = true;
    try {
      while (this.wanted !== null && this.tab === "refocus" && this.layout) {
        const next = this.wanted;
        this.wanted = null;
        await this.loadPicture(`/api/frames/${this.frame.tag.frame}/refocus.jpg?disparity=${next}`, "refocus", this.turn);
        $("caption").textContent = `Views from the ${this.layout?.source}. This browser has no WebGL2: the vehicle makes the picture.`;
      }
    } catch (error) {
      $("caption").textContent = error.message;
    } finally {
      this.asking = false;
    }
  }

  focusAt(x, y) {
    if (this.tab !== "refocus" || !this.layout || !this.bitmap) return;
    const [height, width] = this.layout.tile;
    $("disparity").value = sharpest(this.layout, this.bitmap, x * width, y * height);
    this.draw();
  }

  size() {
    const box = $("frame-box"), aspect = this.aspect ?? 4 / 3;
    const width = Math.min(box.clientWidth, box.clientHeight * aspect);
    box.style.setProperty("--w", `${Math.floor(width)}px`);
    box.style.setProperty("--h", `${Math.floor(width / aspect)}px`);
  }

  overlay(kind) {
    const facts = this.frame?.slices, paper = $("overlay");
    paper.replaceChildren();
    show(paper, false);
    $("caption").replaceChildren();
    if (kind === "slices" && facts) this.labels(paper, facts);
    else if (kind === "spectrum" && facts) this.carriers(paper, facts);
    else if (kind === "views") $("caption").textContent = "Each view comes through its own part of the aperture. All have the same brightness scale.";
    else if (kind === "depth") $("caption").textContent = "Violet: small disparity. Yellow: large disparity. Grey: unknown.";
  }

  labels(paper, facts) {
    const all = facts.carriers.flatMap(([ky, kx]) => [[ky, kx], [-ky, -kx]]);
    const ys = [...new Set(all.map((k) => k[0]))].sort((a, b) => a - b), xs = [...new Set(all.map((k) => k[1]))].sort((a, b) => a - b);
    paper.setAttribute("viewBox", `0 0 ${1000 * this.aspect} 1000`);
    const has = new Set(all.map(String));
    for (const [row, ky] of ys.entries()) for (const [column, kx] of xs.entries()) {
      if (!has.has(String([ky, kx]))) continue;
      const text = svg("text", { x: (column / xs.length) * 1000 * this.aspect + 8, y: (row / ys.length) * 1000 + 26, fill: "#ffe14d", "font-size": 20, stroke: "#000", "stroke-width": 4, "paint-order": "stroke" });
      text.textContent = `${signed(ky)}, ${signed(kx)}`;
      paper.append(text);
    }
    show(paper, true);
    $("caption").textContent = `${facts.shape[0]} slices of ${facts.shape[2]} × ${facts.shape[1]} px by their orders (ky, kx), each on its own scale; the other half plane holds their conjugates.`;
  }

  carriers(paper, facts) {
    const wide = 1000 * this.aspect, size = [1000 / facts.grid[0][0], wide / facts.grid[1][1]];
    paper.setAttribute("viewBox", `0 0 ${wide} 1000`);
    const at = (fy, fx) => [(0.5 + fx) * wide, (0.5 + fy) * 1000];
    const predicted = facts.predicted?.length ? facts.predicted : facts.carriers.map((row) => ({ at: row, seen: null }));
    const halves = (ky, kx) => (ky || kx ? [1, -1] : [1]);   // order (0, 0) has no conjugate
    for (const [ky, kx, fy, fx] of facts.carriers) for (const sign of halves(ky, kx)) {
      const [x, y] = at(sign * fy, sign * fx);
      paper.append(svg("rect", { x: x - size[1] / 2, y: y - size[0] / 2, width: size[1], height: size[0], fill: "none", stroke: "#ff6a5e", "stroke-width": 1.2, opacity: 0.75 }));
    }
    let seen = 0;
    for (const one of predicted) for (const sign of halves(...one.at)) {
      const [ky, kx, fy, fx] = one.at, [x, y] = at(sign * fy, sign * fx);
      const cross = svg("path", { d: `M${x - 11} ${y}h22M${x} ${y - 11}v22`, stroke: "#ffe14d", "stroke-width": 2, fill: "none" });
      cross.append(svg("title", {}, `order ${signed(sign * ky)}, ${signed(sign * kx)}`));
      paper.append(cross);
      if (one.seen && (ky || kx)) {
        const [sx, sy] = at(sign * one.seen[0], sign * one.seen[1]);
        paper.append(svg("circle", { cx: sx, cy: sy, r: 15, stroke: "#5fe08b", "stroke-width": 2.4, fill: "none" }));
        seen += 1;
      }
    }
    show(paper, true);
    const wanted = 2 * (predicted.length - 1);
    $("caption").replaceChildren(
      key("M6 0v12M0 6h12", "#ffe14d", "predicted"), key("M6 1a5 5 0 1 0 .01 0", "#5fe08b", `seen, ${seen} of ${wanted}`), key("M1 1h10v10H1z", "#ff6a5e", "band of a slice"),
      `Slices were cut at the ${{ measured: "carriers seen", calibrated: "calibration's carriers", predicted: "carriers that the law predicts", found: "lattice found in the frame" }[facts.carriers_from] ?? "carriers"}.`,
    );
  }
}

function key(path, colour, text) {
  const picture = svg("svg", { viewBox: "0 0 12 12" }, svg("path", { d: path, stroke: colour, "stroke-width": 2, fill: "none" }));
  return element("span", { class: "key" }, picture, text);
}

// An SVG element has no `hidden` property; the attribute works for both.
function show(one, visible) {
  one.toggleAttribute("hidden", !visible);
}

const signed = (n) => (n > 0 ? `+${n}` : n < 0 ? `−${-n}` : "0");
