// Show the daemon's events on the page. All state is here; the other modules draw.
import { dash, element, fixed, mark, rows, svg, utc } from "./format.js";
import { FieldMap } from "./map.js";
import { image } from "./pictures.js";
import { Settings } from "./settings.js";
import { Stage } from "./stage.js";

const $ = (id) => document.getElementById(id);
const STALE_MS = 3500, DEADLINE_MS = 2000, AGAIN_MS = 1000, BURST_MS = 50;
const stage = new Stage();
const map = new FieldMap($("map"));
const settings = new Settings($("settings"), (name, value) => fire("/api/setting", { name, value }), (text, state) => tell(text, state));
const frames = new Map();   // index → frame event
let token = null, tokenAt = 0;   // the daemon's clock, and when it was heard
let chosen = null, heardAt = 0, utcAt = null, connected = false, ended = null, flight = null, lastLine = 0;
let isRecording = false;   // of `dappled open`: there is no daemon
let interval = null, lastFindings = null, wasStale = false, sending = false, stopping = false, unconfirmed = null;
let following = null;   // of frames that come at once only the last is looked at; of those that a new page is told, when it has all
let stoppedMs = null;   // by the daemon's clock: what began until then was ended by Stop here, and the page says so
let sequence = Math.floor(Math.random() * 2 ** 30);

const handlers = {
  about(event) { recording(event.recording); map.setBackground(event.map); map.setArea(event.area); map.setPath(event.path); if (event.start) began(event.start); },
  start(event) { began(event.start); },
  state(event) { token = event.token; tokenAt = performance.now(); if (event.health) showState(event); tick(); },
  frame: showFrame,
  ready() { connected = true; lookAtNewest(); },
  log(event) { showLog(event.lines); },
  end(event) { ended = event.shots ?? {}; tick(); },
};

function began(start) {
  if (flight && flight !== start.flight) location.reload();   // another flight: start again
  flight = start.flight;
  $("flight").textContent = [start.flight, start.camera, start.mask || "no mask"].join("  ·  ");
}

// Over a recording nothing can be fired, set or awaited: the page leaves out all that would.
function recording(given) {
  isRecording = Boolean(given);
  document.body.toggleAttribute("data-recording", isRecording);
  for (const id of ["tab-live", "clock-box"]) $(id).hidden = isRecording;
}

function showState({ health, findings, verdict, area = null, frames_left: framesLeft = null }) {
  heardAt = performance.now();
  utcAt = health.utc_ns;
  if (flight && health.flight && health.flight !== flight) location.reload();
  if (ended) return;   // the daemon's last record: the flight is over
  if (!flight) $("flight").textContent = health.flight;
  showVerdict(verdict, findings);
  showFindings(findings);
  showCounters(health);
  takeInterval(health.interval ?? null);
  showInterval();
  map.setVehicle(health.vehicle);
  if (area) map.setHoles(area.version);
  showInstruments(health, findings, framesLeft, area);
  settings.show(health.settings ?? []);
  const place = health.vehicle;
  $("map-text").textContent = place
    ? `${fixed(place.latitude_deg, 6)}°, ${fixed(place.longitude_deg, 6)}°  ·  ${fixed(place.height_above_home_m, 1, "m")} up  ·  ${fixed(place.speed_m_s, 1, "m/s")}`
    : "no position yet";
}

// `stale`: what was last heard, which may be wrong by now: grey, and without ticks.
function showFindings(findings, stale = false) {
  lastFindings = findings;
  const state = (one) => (stale ? "unknown" : one.state);
  const item = (one) => element("li", { "data-state": state(one), "data-code": one.code }, mark(state(one)), element("span", {}, told(one), " ", element("code", {}, one.code)), element("small", {}, ageWords(one.age_s)));
  $("checks").replaceChildren(...findings.map(item));
}

const told = (one) => (one.todo ? `${one.text}: ${one.todo}` : one.text);
const ageWords = (seconds) => (seconds < 60 ? `${Math.round(seconds)} s` : `${Math.round(seconds / 60)} min`);

// A record of before the daemon's answer to Stop may still say that the series runs; a later one takes the answer away.
function takeInterval(now) {
  const isOver = now && stoppedMs !== null && now.began_ms <= stoppedMs;
  if (now && !isOver && stoppedMs !== null) {
    stoppedMs = null;
    if ($("outcome").dataset.state === "stopped") tell("");
  }
  interval = isOver ? null : now;
}

function showInterval() {
  const live = interval && !ended;
  $("interval").dataset.running = live ? "yes" : "";
  const due = live && interval.next_s !== null ? Math.max(0, interval.next_s - (performance.now() - heardAt) / 1000) : null;
  const count = live ? (interval.count === null ? `${interval.taken} taken` : `${interval.taken} of ${interval.count}`) : "";
  if (live && "distance_m" in interval) {
    $("progress").textContent = `${count}, ${interval.distance_m === null ? "by overlap" : `one each ${fixed(interval.distance_m, 1)} m`}`;
    return;
  }
  $("progress").textContent = !live ? "" : `${count}, ${due < 0.5 ? "next now" : `next in ${Math.round(due)} s`}`;
}

const VERDICTS = { go: "Go", caution: "Caution", "no-go": "No-go" };

function showVerdict(verdict, findings) {
  const [worst, ...others] = verdict === "go" ? [] : findings.filter((one) => one.state !== "go");
  $("verdict").dataset.state = verdict;
  $("verdict-word").textContent = VERDICTS[verdict];
  $("verdict-text").textContent = worst ? worst.text : "all is well";
  $("verdict-todo").textContent = worst ? worst.todo : "";
  $("verdict-age").textContent = worst ? `${worst.code}, for ${ageWords(worst.age_s)}${others.length ? `, and ${others.length} more below` : ""}` : "";
}

// What a photographer looks at, of the body as it is now; what is not known is "unknown", and never 0.
// `at` is when a value was true (the page's clock). While the camera is away its last words are old: grey, with their age.
function showInstruments(health, findings, framesLeft, area) {
  const body = Object.fromEntries((health.settings ?? []).map((one) => [one.name, one.value]));
  const cell = (name, value, known = true, at = null, isOld = false) => element("div", { "data-known": String(known), "data-old": isOld ? "" : null }, element("dt", {}, name), element("dd", {}, known ? value : "unknown", ...(known && at !== null ? [" ", element("small", { "data-at": at })] : [])));
  const away = findings.find((one) => /^camera\.(absent|starting|faulted)$/.test(one.code)), isAway = !["ready", "busy"].includes(health.camera.state);
  const bodyAt = isAway ? heardAt - 1000 * (away?.age_s ?? 0) : photoAt();   // its settings are read after each frame
  const of = (name, setting, text = (value) => value, at = isAway ? bodyAt : null) => cell(name, body[setting] ? text(body[setting]) : "", Boolean(body[setting]), at, isAway);
  const fix = health.gnss, power = health.vehicle_battery, free = health.disk.free_bytes, newest = [...frames.keys()].at(-1);
  const heardS = health.link.each.map((one) => one.age_s).filter((age) => age !== null);
  $("instruments").replaceChildren(
    of("ISO", "CAM_ISO"),
    of("shutter", "CAM_SHUTTERSPD", (value) => (/^[\d/.]+$/.test(value) ? `${value} s` : value)),
    of("stop", "CAM_APERTURE", (value) => (/^[\d.]+$/.test(value) ? `f/${value}` : value)),
    of("battery", "CAM_BATTERY", (value) => value, bodyAt),
    cell("vehicle's battery", power ? powerWords(power) : "", Boolean(power) && (power.voltage_v ?? power.remaining_percent) !== null, heardAt),
    cell("GNSS", fix ? fixWords(fix) : "", Boolean(fix)),
    cell("link", linkWords(health.link), true, heardS.length ? heardAt - 1000 * Math.min(...heardS) : null),
    cell("photo", newest === undefined ? "none yet" : `#${newest}`, true, photoAt()),
    cell("space", free === null ? "" : `${fixed(free / 1e9, 1, "GB")}`, free !== null, heardAt),
    cell("frames left", framesLeft === null ? "" : framesLeft.toLocaleString("en").replaceAll(",", "\u202f"), framesLeft !== null),
    ...(health.overlap ? [cell("overlap", overlapWords(health.overlap))] : []),
    ...(area ? [cell("area seen", areaWords(area), area.share !== null)] : []),
    histogramCell(),
  );
  showAges();
}

// When the newest photograph was taken; null where the clocks can't say so.
function photoAt() {
  const taken = [...frames.values()].at(-1)?.tag.utc_ns ?? null;
  return taken === null || utcAt === null || taken > utcAt ? null : heardAt - (utcAt - taken) / 1e6;
}

function showAges() {
  for (const one of document.querySelectorAll("#instruments [data-at]")) {
    const age = (performance.now() - Number(one.dataset.at)) / 1000, words = age < 2 ? "now" : ageWords(age);
    if (one.textContent !== words) one.textContent = words;
  }
}

function linkWords({ urls, silent }) {
  return !urls ? "none" : silent === urls ? "silent" : silent ? `${urls - silent} of ${urls} heard` : "heard";
}

const FIXES = ["no GNSS", "no fix", "2D", "3D", "DGPS", "RTK float", "RTK fixed", "static", "PPP"];
function fixWords({ fix_type: type, satellites }) {
  const word = FIXES[type] ?? `fix ${type}`;
  return satellites === null ? word : `${word}, ${satellites} sat.`;
}

function powerWords({ voltage_v: volts, remaining_percent: percent, low }) {
  return [percent === null ? "" : `${percent} %`, volts === null ? "" : `${fixed(volts, 1)} V`, low ? "low" : ""].filter(Boolean).join(", ");
}

const overlapWords = ({ share, apart_m: apart }) => (share < 0 ? `none, ${fixed(apart, 1)} m apart` : `${Math.floor(100 * share)} %, ${fixed(apart, 1)} m apart`);

// Rounded down: 100 % has no hole.
function areaWords({ share, frames: count }) {
  return `${Math.floor(share * 1000) / 10} % by ${count} ${count === 1 ? "frame" : "frames"}`;
}

// The histogram of the frame that is shown, and how much of it is clipped.
function histogramCell() {
  const { histogram, clipped_share: clipped } = frames.get(chosen)?.slices ?? {};
  if (!histogram) return element("div", { "data-known": "false", class: "histogram" }, element("dt", {}, "histogram"), element("dd", {}, "unknown"));
  const highest = Math.max(...histogram.slice(1, -1), 1e-9), n = histogram.length;
  const bars = histogram.map((share, at) => `M${at + 0.5} 24V${(24 - 24 * Math.min(1, share / highest)).toFixed(2)}`).join("");
  const drawn = svg("svg", { viewBox: `0 0 ${n} 24`, preserveAspectRatio: "none", role: "img", "aria-label": "histogram of the frame, black to white" }, svg("path", { d: bars, stroke: "currentColor", "stroke-width": 1 }));
  const text = clipped < 0.0005 ? "< 0.1 % clipped" : `${fixed(100 * clipped, 1)} % clipped`;
  return element("div", { class: "histogram", "data-known": "true", "data-clipped": clipped > 0.01 ? "much" : null }, element("dt", {}, drawn), element("dd", {}, text));
}

function showCounters(health) {
  const { shots } = health, stages = Object.fromEntries(health.stages.map((one) => [one.name, one]));
  const publish = stages.publish ?? { sent: {}, dropped: {} };
  const dropped = Object.values(publish.dropped).reduce((sum, n) => sum + n, 0);
  rows($("counters"), [
    ["taken", shots.wished - shots.failed],
    ["on disk", shots.safe],
    ["refused", shots.refused, shots.refused > 0],
    ["lost", shots.failed + shots.lost, shots.failed + shots.lost > 0],
    ["decoded", stages.decode ? stages.decode.done : dash],
    ["not decoded", stages.decode ? stages.decode.dropped + stages.decode.failed : dash, stages.decode && stages.decode.dropped + stages.decode.failed > 0],
    ["published", publish.sent.slices ?? 0],
    ["not published", dropped, dropped > 0],
  ]);
}

function showFrame(event) {
  const index = event.tag.frame, before = frames.get(index);
  const frame = { ...event, slices: event.slices ?? before?.slices ?? null, verdict: event.verdict ?? before?.verdict ?? null };
  frames.set(index, frame);
  if (frames.size > 400) frames.delete(frames.keys().next().value);
  map.setFrame(index, frame.corners, frame.thumb);
  showThumb(index, frame);
  if (chosen === index) choose(index);
  else if (connected) {
    clearTimeout(following);
    following = setTimeout(lookAtNewest, BURST_MS);
  }
}

function lookAtNewest() {
  const newest = newestWith("thumb") ?? [...frames.values()].at(-1);
  if (newest && (chosen === null || $("follow").checked)) choose(newest.tag.frame);
}

const newestWith = (part) => [...frames.values()].findLast((one) => one[part]);

// Unfollowed, the page stays with the frame that is seen.
function follow() {
  if ($("follow").checked) lookAtNewest();
  else if (stage.shown) choose(stage.shown.tag.frame);
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
  if (frame.verdict && button.dataset.verdict !== frame.verdict.state) {
    button.dataset.verdict = frame.verdict.state;
    const words = [`frame ${index}: ${frame.verdict.state}`, ...frame.verdict.reasons].join("; ");
    button.setAttribute("aria-label", words);
    button.title = words;
  }
  if (frame.thumb && !button.querySelector("img")) button.firstChild.replaceWith(image(`/api/frames/${index}/thumb.jpg`, undefined, { alt: "" }));
}

function choose(index) {
  clearTimeout(following);
  chosen = index;
  const frame = frames.get(index);
  for (const one of $("strip").children) one.setAttribute("aria-selected", String(Number(one.dataset.frame) === index));
  map.select(index);
  showFacts(frame);
  if (isRecording) showRecorded(frame);
  else document.querySelector("#instruments .histogram")?.replaceWith(histogramCell());
  stage.set(frame, $("follow").checked ? { picture: newestWith("picture"), depth: newestWith("depth") } : {});
}

// Of a recording: the histogram above the picture, and the frame's own place below the map.
function showRecorded({ tag: { frame, pose } }) {
  $("instruments").replaceChildren(histogramCell());
  $("map-text").textContent = pose.latitude_deg === null ? `frame ${frame}: no position` : `frame ${frame}: ${fixed(pose.latitude_deg, 6)}°, ${fixed(pose.longitude_deg, 6)}°  ·  ${fixed(pose.height_above_home_m, 1, "m")} up`;
}

function showFacts({ tag, slices, verdict }) {
  const pose = tag.pose, known = pose.latitude_deg !== null;
  const exposure = tag.exposure_s ? (tag.exposure_s < 0.5 ? `1/${Math.round(1 / tag.exposure_s)} s` : `${tag.exposure_s} s`) : dash;
  rows($("facts"), [
    ["verdict", verdict ? verdict.state : "not judged yet", verdict?.state === "bad"],
    ...(verdict?.reasons ?? []).map((reason) => ["because", reason, verdict.state === "bad"]),
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
  const age = performance.now() - heardAt, lost = heardAt > 0 && age > STALE_MS, stale = lost || Boolean(ended);
  const words = isRecording ? recordingWords() : ended ? "ended" : lost ? `silent ${Math.round(age / 1000)} s` : connected ? "live" : "connecting";
  $("contact").textContent = words;
  $("contact").dataset.state = (isRecording ? !connected : lost && !ended) ? "lost" : "live";
  if (utcAt !== null && !stale) $("clock").textContent = utc(utcAt + age * 1e6);
  if (stale !== wasStale && !isRecording) {
    wasStale = stale;
    document.body.toggleAttribute("data-stale", stale);
    if (lastFindings) showFindings(lastFindings, stale);
  }
  if (ended) {
    $("verdict").dataset.state = "ended";
    $("verdict-word").textContent = "Ended";
    $("verdict-text").textContent = recorded(ended);
    for (const id of ["verdict-age", "verdict-todo"]) $(id).textContent = "";
  } else if (lost) {
    $("verdict").dataset.state = "lost";
    $("verdict-word").textContent = "No contact";
    $("verdict-text").textContent = `last heard ${Math.round(age / 1000)} s ago`;
    for (const id of ["verdict-age", "verdict-todo"]) $(id).textContent = "";
  }
  showInterval();
  showAges();
  const able = token !== null && !stale && !sending && !unconfirmed;
  $("shoot").disabled = !able;
  $("interval-go").disabled = !able || Boolean(interval);
  settings.enable(able);
  $("interval-stop").disabled = Boolean(ended) || stopping || !(interval || lost);
  $("interval-stop").textContent = stopping ? "Stopping…" : "Stop";
}

const recordingWords = () => (!connected ? "no answer: has dappled open ended?" : ended ? `recording  ·  ${recorded(ended)}` : "recording");

// What a flight brought, in words.
function recorded({ wished = 0, safe = 0, failed = 0 }) {
  if (!wished) return "no shot was taken";
  const counted = (n, word) => `${n} ${word}${n === 1 ? "" : "s"}`;
  const rest = wished - safe - failed;
  return [`${counted(wished, "shot")}: ${counted(safe, "frame")} recorded`, failed ? `${failed} failed` : "", rest > 0 ? `${rest} without a file yet` : ""].filter(Boolean).join(", ");
}

// Throws where no answer comes in time.
async function post(path, body, patience = DEADLINE_MS) {
  const answer = await fetch(path, { method: "POST", headers: { "content-type": "application/json" }, body: JSON.stringify(body), signal: AbortSignal.timeout(patience) });
  if (answer.status === 401) login();
  return await answer.json();
}

function tell(text, state = "") {
  $("outcome").textContent = text;
  $("outcome").dataset.state = state;
}

const tellAnswer = (answer) => tell(answer.ok ? answer.text : answer.error ?? "refused", answer.ok ? "" : "bad");

// A request that may fire, or set something, is sent once, with the daemon's clock: it refuses what comes later than two seconds.
async function fire(path, body) {
  sequence = (sequence + 1) % 2 ** 31;
  const request = { sequence, token, elapsed_ms: Math.round(performance.now() - tokenAt), ...body };
  const kind = path === "/api/setting" ? "set" : "fire";
  sending = true;
  tell("sending…", "busy");
  tick();
  let answer = null;
  try {
    answer = await post(path, request);
    tellAnswer(answer);
  } catch {
    keep({ ...request, kind });
  }
  sending = false;
  tick();
  if (unconfirmed) settle();
  return answer ? Boolean(answer.ok) : true;   // without an answer it may have been taken
}

// A request without an answer. It outlives a reload of the page: the question is still open then.
function keep(request) {
  unconfirmed = request;
  stored("unconfirmed", request && { sequence: request.sequence, token: request.token, elapsed_ms: request.elapsed_ms, kind: request.kind });
}

// Keep a value for the page's next life, or forget it (null).
function stored(name, value) {
  try {
    if (value) sessionStorage.setItem(name, JSON.stringify(value));
    else sessionStorage.removeItem(name);
  } catch { /* without storage a reload forgets it */ }
}

function recalled(name) {
  try { return JSON.parse(sessionStorage.getItem(name)); } catch { return null; }
}

const UNCONFIRMED = {
  fire: {
    open: "not confirmed; it may have fired",
    never: "nothing was fired: the request did not reach the vehicle in time",
    restarted: "not confirmed; the daemon was started again since: see whether the frame is there",
  },
  set: {
    open: "not confirmed; it may have been set",
    never: "nothing was set: the request did not reach the vehicle in time",
    restarted: "not confirmed; the daemon was started again since: see what the setting is",
  },
};

// Ask what became of it until the daemon says so.
async function settle() {
  const { sequence, token, elapsed_ms, kind } = unconfirmed, words = UNCONFIRMED[kind] ?? UNCONFIRMED.fire;
  while (unconfirmed) {
    tell(words.open, "bad");
    try {
      const answer = await post("/api/outcome", { sequence, token, elapsed_ms });
      if (answer.ok && answer.state !== "waiting") {
        keep(null);
        if (answer.state === "known") tellAnswer(answer.answer);
        else if (answer.state === "never") tell(words.never, "bad");
        else tell(words.restarted, "bad");
        break;
      }
    } catch { /* no link yet */ }
    await new Promise((done) => setTimeout(done, AGAIN_MS));
  }
  tick();
}

$("shoot").addEventListener("click", () => fire("/api/shoot", {}));
$("interval").addEventListener("submit", (event) => {
  event.preventDefault();
  if ($("interval-go").disabled) return;
  const seconds = $("interval-s").valueAsNumber, count = $("interval-count").valueAsNumber;
  if (!(seconds >= 0) || !Number.isInteger(count) || count < 0) { tell("give seconds from 0 and a whole number of frames", "bad"); return; }
  fire("/api/interval", { interval_s: seconds, count });
});
$("interval-stop").addEventListener("click", () => stop({ token: token ?? "", elapsed_ms: Math.round(performance.now() - tokenAt) }));

// To stop is safe at any time: it is sent until the daemon itself has answered, also after a reload of the page.
// It carries when it was pressed, so that one that comes late does not end an interval that was begun since.
async function stop(pressed) {
  stopping = true;
  stored("stop", pressed);
  tell("stopping…", "busy");
  tick();
  for (;;) {
    const answer = await post("/api/interval/stop", pressed).catch(() => ({}));
    if ("ok" in answer) {   // the daemon's; others are of what lies between
      if (answer.ok && !answer.restarted) {   // of another start, the press says nothing of what runs now
        interval = null;
        stoppedMs = Number(pressed.token.split("-").at(-1)) + pressed.elapsed_ms + 1;
      }
      tell(answer.ok ? answer.text : answer.error, answer.ok ? "stopped" : "bad");
      break;
    }
    if (ended) { tell("the flight has ended, and what ran with it"); break; }
    tell(`not confirmed${answer.error ? ` (${answer.error})` : ""}; it may still be shooting: sent again until it is`, "bad");
    await new Promise((done) => setTimeout(done, AGAIN_MS));
  }
  stored("stop", null);
  stopping = false;
  tick();
}

$("follow").addEventListener("change", follow);
$("map-in").addEventListener("click", () => map.zoom(1.5));
$("map-out").addEventListener("click", () => map.zoom(1 / 1.5));
$("map-fit").addEventListener("click", () => { map.following = true; map.redraw(); });

function login() {
  if (!$("login").open) $("login").showModal();
}
$("login").addEventListener("cancel", (event) => event.preventDefault());
$("login-form").addEventListener("submit", async (event) => {
  event.preventDefault();
  const answer = await post("/api/login", { token: $("token").value }, 10_000).catch(() => ({ error: "the vehicle can't be reached: try again" }));
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
    await post("/api/login", { token: given }, 10_000).catch(() => login());
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
unconfirmed = recalled("unconfirmed");
if (unconfirmed) settle();
const unanswered = recalled("stop");
if (unanswered) stop(unanswered);
tick();
connect();
