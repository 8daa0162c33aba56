// Show the daemon's events on the page. All state is here; the other modules draw.
import { dash, element, fixed, mark, rows, utc } from "./format.js";
import { FieldMap } from "./map.js";
import { Stage } from "./stage.js";

const $ = (id) => document.getElementById(id);
const STALE_MS = 3500;
const stage = new Stage();
const map = new FieldMap($("map"));
const frames = new Map();   // index → frame event
let chosen = null, heardAt = 0, utcAt = null, connected = false, ended = false, flight = null, lastLine = 0;
let sequence = Math.floor(Math.random() * 2 ** 30);

const handlers = {
  about(event) { map.setBackground(event.map); map.setPath(event.path); if (event.start) began(event.start); },
  start(event) { began(event.start); },
  state(event) { if (event.health) showState(event); },
  frame: showFrame,
  ready() { connected = true; },
  log(event) { showLog(event.lines); },
  end() { ended = true; },
};

function began(start) {
  if (flight && flight !== start.flight) location.reload();   // another flight: start again
  flight = start.flight;
  $("flight").textContent = [start.flight, start.camera, start.mask || "no mask"].join("  ·  ");
}

function showState({ health, checks, verdict }) {
  heardAt = performance.now();
  utcAt = health.utc_ns;
  ended = false;
  if (!flight) $("flight").textContent = health.flight;
  showVerdict(verdict, checks);
  $("checks").replaceChildren(...checks.map((one) => element("li", { "data-state": one.state }, mark(one.state), element("b", {}, one.name), element("span", {}, one.text))));
  showCounters(health);
  const running = health.interval_s !== null && health.interval_s !== undefined;
  $("interval-go").textContent = running ? "Stop" : "Start";
  $("interval").dataset.running = running ? health.interval_s : "";
  map.setVehicle(health.vehicle);
  const place = health.vehicle;
  $("map-text").textContent = place
    ? `${fixed(place.latitude_deg, 6)}°, ${fixed(place.longitude_deg, 6)}°  ·  ${fixed(place.height_above_home_m, 1, "m")} up  ·  ${fixed(place.speed_m_s, 1, "m/s")}`
    : "no position yet";
}

function showVerdict(verdict, checks) {
  const bad = checks.filter((one) => one.state === "no-go"), cautions = checks.filter((one) => one.state === "caution");
  $("verdict").dataset.state = verdict;
  $("verdict-word").textContent = verdict === "no-go" ? "No-go" : "Go";
  const names = (list) => list.map((one) => one.name.toLowerCase()).join(", ");
  $("verdict-text").textContent = verdict === "no-go" ? names(bad) : verdict === "caution" ? `with caution: ${names(cautions)}` : `all ${checks.length} checks pass`;
}

function showCounters(health) {
  const { shots } = health, stages = Object.fromEntries(health.stages.map((one) => [one.name, one]));
  const publish = stages.publish ?? { sent: {}, dropped: {} };
  const dropped = Object.values(publish.dropped).reduce((sum, n) => sum + n, 0);
  rows($("counters"), [
    ["requested", shots.wished],
    ["safe on disk", shots.safe],
    ["under way", shots.pending],
    ["failed", shots.failed, shots.failed > 0],
    ["refused", shots.refused, shots.refused > 0],
    ["decoded", stages.decode ? stages.decode.done : dash],
    ["not decoded", stages.decode ? stages.decode.dropped + stages.decode.failed : dash, stages.decode && stages.decode.dropped + stages.decode.failed > 0],
    ["published", publish.sent.slices ?? 0],
    ["not published", dropped, dropped > 0],
  ]);
}

function showFrame(event) {
  const index = event.tag.frame, before = frames.get(index);
  const frame = { ...event, slices: event.slices ?? before?.slices ?? null };
  frames.set(index, frame);
  if (frames.size > 400) frames.delete(frames.keys().next().value);
  map.setFrame(index, frame.corners, frame.thumb);
  showThumb(index, frame);
  const newest = [...frames].filter(([, one]) => one.thumb).at(-1) ?? [...frames].at(-1);
  if (chosen === index || ($("follow").checked && newest[0] === index)) choose(index);
  else if (chosen === null) choose(newest[0]);
}

function showThumb(index, frame) {
  let button = document.querySelector(`#strip [data-frame="${index}"]`);
  if (!button) {
    button = element("button", { type: "button", role: "option", "data-frame": index, "aria-selected": "false", "aria-label": `frame ${index}` }, element("i"), String(index));
    button.addEventListener("click", () => { $("follow").checked = false; choose(index); });
    const after = [...$("strip").children].find((one) => Number(one.dataset.frame) < index);
    $("strip").insertBefore(button, after ?? null);
    while ($("strip").children.length > 40) $("strip").lastChild.remove();
  }
  if (frame.thumb && !button.querySelector("img")) button.firstChild.replaceWith(element("img", { src: `/api/frames/${index}/thumb.jpg`, alt: "" }));
}

function choose(index) {
  chosen = index;
  const frame = frames.get(index);
  for (const one of $("strip").children) one.setAttribute("aria-selected", String(Number(one.dataset.frame) === index));
  map.select(index);
  showFacts(frame);
  stage.set(frame);
}

function showFacts({ tag, slices }) {
  const pose = tag.pose, known = pose.latitude_deg !== null;
  const exposure = tag.exposure_s ? (tag.exposure_s < 0.5 ? `1/${Math.round(1 / tag.exposure_s)} s` : `${tag.exposure_s} s`) : dash;
  rows($("facts"), [
    ["exposed", `${utc(tag.utc_ns, true)} ±${fixed(tag.utc_sigma_ns / 1e6, 1, "ms")}`],
    ["position", known ? `${fixed(pose.latitude_deg, 6)}°, ${fixed(pose.longitude_deg, 6)}°` : "unknown", !known],
    ["accuracy", `±${fixed(pose.position_sigma_m, 2, "m")}`],
    ["height", fixed(pose.height_above_home_m, 1, "m")],
    ["roll, pitch, yaw", [pose.roll_deg, pose.pitch_deg, pose.yaw_deg].map((one) => fixed(one, 1, "")).join("°, ") + "°"],
    ["lens", `${fixed(tag.focal_length_mm, 0, "mm")}, f/${tag.f_number ?? dash}, ${exposure}, ISO ${tag.iso ?? dash}`],
    ["carriers", slices ? `${slices.carriers_found === null ? "not observable at this aperture" : `${slices.carriers_found} seen`}, ${slices.carriers_from}` : tag.mask ? "not decoded here yet" : "no mask"],
    ...(slices?.doubts ?? []).map((doubt) => ["doubt", doubt, true]),
    ["file", `${tag.name}, ${fixed(tag.size / 1e6, 1, "MB")}`],
  ]);
}

function showLog(lines) {
  const list = $("log");
  for (const line of lines) {
    if (line.number <= lastLine) continue;
    lastLine = line.number;
    list.prepend(element("li", { "data-level": line.level }, element("time", {}, utc(line.utc_ns)), element("span", {}, line.text)));
  }
  while (list.children.length > 200) list.lastChild.remove();
}

function tick() {
  const age = performance.now() - heardAt, lost = heardAt > 0 && age > STALE_MS;
  const words = ended && lost ? "the flight has ended" : lost ? `nothing heard for ${Math.round(age / 1000)} s` : connected ? "live" : "connecting";
  $("contact").textContent = words;
  $("contact").dataset.state = lost ? "lost" : "live";
  if (utcAt !== null) $("clock").textContent = utc(utcAt + age * 1e6);
  if (lost) {
    $("verdict").dataset.state = "lost";
    $("verdict-word").textContent = ended ? "Ended" : "No contact";
    $("verdict-text").textContent = ended ? "the flight has ended" : `last heard ${Math.round(age / 1000)} s ago`;
  }
}

async function post(path, body) {
  for (let attempt = 0; ; attempt++) {
    try {
      const answer = await fetch(path, { method: "POST", headers: { "content-type": "application/json" }, body: JSON.stringify(body) });
      if (answer.status === 401) login();
      return await answer.json();
    } catch (error) {
      if (attempt >= 1) return { ok: false, error: "the vehicle can't be reached; check the counters before you try again" };
    }   // again with the same number: the daemon takes both for one request
  }
}

function tell(answer) {
  $("outcome").textContent = answer.ok ? answer.text : answer.error ?? "refused";
  $("outcome").dataset.state = answer.ok ? "" : "bad";
}

const next = () => (sequence = (sequence + 1) % 2 ** 31);

$("shoot").addEventListener("click", async () => tell(await post("/api/shoot", { sequence: next() })));
$("interval").addEventListener("submit", async (event) => {
  event.preventDefault();
  if ($("interval").dataset.running) { tell(await post("/api/interval/stop", {})); return; }
  const seconds = $("interval-s").valueAsNumber, count = $("interval-count").valueAsNumber;
  if (!(seconds >= 0) || !Number.isInteger(count) || count < 0) { tell({ ok: false, error: "give seconds from 0 and a whole number of frames" }); return; }
  tell(await post("/api/interval", { sequence: next(), interval_s: seconds, count }));
});
$("follow").addEventListener("change", () => { if ($("follow").checked && frames.size) choose([...frames.keys()].at(-1)); });
$("map-in").addEventListener("click", () => map.zoom(1.5));
$("map-out").addEventListener("click", () => map.zoom(1 / 1.5));
$("map-fit").addEventListener("click", () => { map.following = true; map.redraw(); });

function login() {
  if (!$("login").open) $("login").showModal();
}
$("login").addEventListener("cancel", (event) => event.preventDefault());
$("login-form").addEventListener("submit", async (event) => {
  event.preventDefault();
  const answer = await post("/api/login", { token: $("token").value });
  $("token").value = "";
  if (answer.ok) { $("login").close(); connect(); }
  else $("login-text").textContent = answer.error;
});

let stream = null;
async function connect() {
  stream?.close();
  const given = new URLSearchParams(location.hash.slice(1)).get("token");   // after the #, so that it is in no log
  if (given) {
    history.replaceState(null, "", location.pathname);
    await post("/api/login", { token: given });
  }
  let status = 0;
  try { status = (await fetch("/api/state")).status; } catch { /* no connection: tried again below */ }
  if (status === 401) { login(); return; }
  if (status !== 200) { setTimeout(connect, 1500); return; }
  stream = new EventSource("/api/events");
  stream.onmessage = (message) => { const event = JSON.parse(message.data); handlers[event.is]?.(event); };
  stream.onerror = () => { connected = false; if (stream.readyState === EventSource.CLOSED) setTimeout(connect, 1500); };
}

setInterval(tick, 250);
connect();
