"use strict";
// A run on its time line: the server draws the frame that is asked for, all else is drawn here.
const DEG = 180 / Math.PI;
const COLOURS = { TRACKING: "--blue", ONE_LINE: "--yellow", COASTING: "--orange", LOST: "--stop" };
const PLOTS = [ // title, unit, column, factor, least span
  ["Offset, with its bound", "cm", "offset", 100, 10],
  ["Heading", "deg", "heading", DEG, 10],
  ["Steering", "deg", "steering", DEG, 10],
  ["Time a frame", "ms", "ms", 1, 5],
  ["Speed", "m/s", "speed", 1, 0.5],
];
const at = (id) => document.getElementById(id);
let run = null;
let eye = ""; // the pipeline that is shown
let now = 0; // number of the frame
let shown = 0; // number of the frame whose pictures are shown, or being drawn
let asked = null; // the image that the server is drawing for, and the frame and pipeline asked for
let playing = false;
let since = 0; // wall time [ms] and run's time [s] at which playing began
let from = 0;
let socket = null;
let drawn = ""; // what the plots show

const canvases = PLOTS.map(([title]) => {
  const head = document.createElement("h2");
  const value = document.createElement("b");
  const canvas = document.createElement("canvas");
  canvas.setAttribute("aria-label", title);
  head.append(title, value);
  at("timeline").append(head, canvas);
  canvas.addEventListener("pointerdown", (event) => { canvas.setPointerCapture(event.pointerId); scrub(canvas, event); });
  canvas.addEventListener("pointermove", (event) => { if (event.buttons) scrub(canvas, event); });
  return [canvas, value];
});

function connect() {
  const token = location.hash.slice(1);
  if (!token) return tell("open the address that automodel view printed, with all that follows the #");
  socket = new WebSocket("ws://" + location.host + "/socket");
  socket.binaryType = "blob";
  socket.onopen = () => socket.send(token);
  socket.onmessage = (event) => (typeof event.data === "string" ? told(JSON.parse(event.data)) : show(event.data));
  socket.onclose = (event) => tell(event.code === 4401 ? "the token is wrong: open the address that automodel view printed" : "automodel view has ended");
}

function tell(reason) {
  at("reason").textContent = reason;
  playing = false;
}

function told(news) {
  if (news.trial) return tried(news.trial);
  if (!news.eyes) return; // whose picture comes next: it is the one that was asked for
  run = news;
  at("name").textContent = run.name;
  tell(run.t.length + " frames, " + duration().toFixed(1) + " s");
  showEyes();
  choose(Object.keys(run.eyes)[0]);
}

function showEyes() {
  at("eyes").replaceChildren(...Object.keys(run.eyes).map((name, i) => {
    const button = document.createElement("button");
    button.type = "button";
    button.textContent = name;
    button.title = i + 1 + ": " + run.eyes[name].words;
    button.addEventListener("click", () => choose(name));
    return button;
  }));
}

function duration() { return run.t[run.t.length - 1]; }

function choose(name) {
  if (!run || !run.eyes[name]) return;
  eye = name;
  for (const button of at("eyes").children) button.setAttribute("aria-pressed", String(button.textContent === name));
  at("events").replaceChildren(...run.eyes[eye].marks.map(([t, text]) => {
    const item = document.createElement("li");
    for (const part of [t.toFixed(2) + " s", text]) {
      const span = document.createElement("span");
      span.textContent = part;
      item.append(span);
    }
    item.tabIndex = 0;
    item.addEventListener("click", () => jump(t));
    item.addEventListener("keydown", (event) => { if (event.key === "Enter") jump(t); });
    return item;
  }));
  showSettings();
  const base = run.eyes[eye].base;
  at("before").hidden = base === null;
  at("live").className = base === null ? "" : "pair";
  at("caption").textContent = run.eyes[eye].words;
  at("before-caption").textContent = base === null ? "" : "before: " + run.eyes[base].words;
  compare();
  go(now);
}

function go(number) { // show this frame as soon as the server has drawn the last one
  if (!run) return;
  now = Math.min(Math.max(number, 0), run.t.length - 1);
  request();
}

function request() {
  if (asked !== null || socket.readyState !== WebSocket.OPEN) return;
  let next = missing();
  if (!next && shown !== now) { // both pictures of a frame, then those of the next one
    shown = now;
    next = missing();
  }
  if (!next) return;
  asked = next;
  socket.send(asked[1]);
}

function missing() { // the image, and the frame and pipeline, that is shown next
  const base = run.eyes[eye].base;
  const wanted = [[at("picture"), shown + " " + eye]];
  if (base !== null) wanted.push([at("original"), shown + " " + base]);
  return wanted.find(([image, text]) => image.dataset.shown !== text);
}

function show(picture) {
  const [image, text] = asked;
  const before = image.src;
  image.src = URL.createObjectURL(picture);
  image.dataset.shown = text;
  if (before) URL.revokeObjectURL(before);
  asked = null;
  request(); // the time line has moved on meanwhile
}

// --- a key of car.toml that is changed

function showSettings() {
  const [settings, chosen] = [run.eyes[eye].settings, at("key").value];
  at("key").replaceChildren(...Object.keys(settings).map((name) => new Option(name, name)));
  at("key").value = chosen in settings ? chosen : "lane.width_m";
  showValue();
}

function showValue() { at("value").value = String(run.eyes[eye].settings[at("key").value]); }

function outcome(text, bad) {
  at("outcome").textContent = text;
  at("outcome").className = bad ? "bad" : "";
}

function tryChange() {
  const value = at("value").value.trim();
  if (!run || socket.readyState !== WebSocket.OPEN) return;
  if (!/^\S{1,40}$/.test(value)) return outcome("expected a number or a word", true);
  outcome("running " + run.eyes[eye].words + " again");
  socket.send(["try", at("key").value, value, eye].join(" "));
}

function tried(news) {
  if (news.wrong) return outcome(news.wrong, true);
  if (news.done) return outcome(news.done + " of " + news.of + " frames");
  run.eyes[news.eye] = news.track;
  outcome(news.track.words);
  showEyes();
  choose(news.eye);
}

function compare() { // the shown pipeline beside the one that it was changed from
  const changed = run.eyes[eye];
  const base = run.eyes[changed.base];
  at("difference").hidden = !base;
  if (!base) return;
  const share = (track, names) => (100 * track.status.filter((name) => names.includes(name)).length) / track.status.length;
  const middle = (values) => {
    const known = values.filter((value) => value !== null && !Number.isNaN(value)).sort((a, b) => a - b);
    return known.length ? known[known.length >> 1] : NaN;
  };
  const apart = changed.offset.map((value, i) => (value === null || base.offset[i] === null ? null : 100 * Math.abs(value - base.offset[i])));
  const rows = [
    ["lane known [%]", (track) => 100 - share(track, ["LOST"])],
    ["two lines [%]", (track) => share(track, ["TRACKING"])],
    ["bound, median [cm]", (track) => 100 * middle(track.bound)],
    ["time, median [ms]", (track) => middle(track.ms)],
  ].map(([name, of]) => [name, of(base), of(changed)]);
  if (changed.base === "recorded") rows[3][1] = NaN; // from the camera to the command, on another machine
  rows.push(["offset apart, median [cm]", NaN, middle(apart)], ["offset apart, most [cm]", NaN, extent(apart)[1]]);
  const written = (value) => (Number.isNaN(value) ? "" : value.toFixed(1));
  const cells = [["", "before", "changed"], ...rows.map(([name, before, after]) => [name, written(before), written(after)])];
  at("difference").replaceChildren(...cells.map((texts, row) => {
    const line = document.createElement("tr");
    line.append(...texts.map((text) => {
      const cell = document.createElement(row ? "td" : "th");
      cell.textContent = text;
      return cell;
    }));
    return line;
  }));
}

function numberAt(t) { // the last frame that is not after t [s]
  let [low, high] = [0, run.t.length - 1];
  while (low < high) {
    const middle = Math.ceil((low + high) / 2);
    if (run.t[middle] <= t + 1e-6) low = middle;
    else high = middle - 1;
  }
  return low;
}

function jump(t) {
  if (!run) return;
  playing = false;
  go(numberAt(t));
}

function mark(direction) { // the next or previous event of the shown pipeline; a frame's own does not count
  if (!run) return;
  const numbers = run.eyes[eye].marks.map(([t]) => numberAt(t)).filter((number) => direction * (number - now) > 0);
  if (!numbers.length) return tell(direction > 0 ? "no later event" : "no earlier event");
  playing = false;
  go(direction > 0 ? Math.min(...numbers) : Math.max(...numbers));
}

function step(frames) {
  playing = false;
  go(now + frames);
}

function toggle() {
  if (!run) return;
  playing = !playing;
  if (playing && now === run.t.length - 1) now = 0;
  restart();
}

function restart() { [since, from] = [performance.now(), run ? run.t[now] : 0]; }

function scrub(canvas, event) {
  if (!run) return;
  const box = canvas.getBoundingClientRect();
  jump(duration() * Math.min(Math.max((event.clientX - box.left) / box.width, 0), 1));
}

// --- drawing, once a picture of the screen

function columnOf(name, column) { return column === "speed" ? run.speed : run.eyes[name][column]; }

function plot([canvas, label], [, unit, column, factor, least]) {
  const [pen, w, h] = surface(canvas);
  const values = columnOf(eye, column).map((value) => (value === null ? null : value * factor));
  const [low, high] = extent(values);
  label.textContent = values[now] === null ? "-" : values[now].toFixed(unit === "m/s" ? 2 : 1) + " " + unit;
  const [middle, span] = [(low + high) / 2, Math.max(least, (high - low) * 1.2)];
  const x = (i) => (duration() > 0 ? (w * run.t[i]) / duration() : 0);
  const y = (value) => h * (0.5 - (value - middle) / span);
  if (column === "offset") drawStatus(pen, x, h);
  pen.strokeStyle = ink("--rule");
  trace(pen, [[0, y(0)], [w, y(0)]]);
  const every = Math.max(1, Math.floor(values.length / (4 * w))); // points that the screen can show
  const line = (list, place) => trace(pen, list.map((value, i) => (i % every ? undefined : place(value, i))).filter((point) => point !== undefined));
  if (column !== "speed" && column !== "ms") {
    pen.strokeStyle = ink("--faint");
    for (const other of Object.keys(run.eyes)) {
      if (other !== eye) line(columnOf(other, column), (value, i) => (value === null ? null : [x(i), y(value * factor)]));
    }
  }
  if (column === "offset") {
    const bound = run.eyes[eye].bound;
    pen.strokeStyle = ink("--orange");
    for (const side of [1, -1]) line(values, (value, i) => (value === null || bound[i] === null ? null : [x(i), y(value + side * factor * bound[i])]));
  }
  pen.strokeStyle = ink("--blue");
  pen.lineWidth = 1.5;
  line(values, (value, i) => (value === null ? null : [x(i), y(value)]));
  pen.fillStyle = ink("--orange");
  for (const [t] of run.eyes[eye].marks) pen.fillRect((w * t) / Math.max(duration(), 1e-9) - 0.5, 0, 1, 6);
  pen.fillStyle = ink("--ink");
  pen.fillRect(x(now) - 0.5, 0, 1, h);
  pen.fillStyle = ink("--faint");
  pen.fillText((middle + span / 2).toFixed(1), 2, 16);
  pen.fillText((middle - span / 2).toFixed(1), 2, h - 8);
}

function extent(values) {
  let [low, high] = [Infinity, -Infinity];
  for (const value of values) {
    if (value === null) continue;
    if (value < low) low = value;
    if (value > high) high = value;
  }
  return low > high ? [0, 0] : [low, high];
}

function drawStatus(pen, x, h) { // a strip along the lower edge, each stretch of a status at once
  const status = run.eyes[eye].status;
  for (let first = 0; first < status.length;) {
    let end = first + 1;
    while (end < status.length && status[end] === status[first]) end += 1;
    pen.fillStyle = ink(COLOURS[status[first]]);
    pen.fillRect(x(first), h - 5, Math.max(x(Math.min(end, status.length - 1)) - x(first), 1), 5);
    first = end;
  }
}

function drawMap() {
  const [pen, w, h] = surface(at("map"));
  if (!run.path) return pen.fillText("no motion is known of this run", 10, 20);
  const [x0, x1] = extent(run.path.map((place) => place[0]));
  const [y0, y1] = extent(run.path.map((place) => place[1]));
  const scale = Math.min((w - 40) / Math.max(x1 - x0, 1), (h - 40) / Math.max(y1 - y0, 1));
  const place = ([px, py]) => [w / 2 + (px - (x0 + x1) / 2) * scale, h / 2 - (py - (y0 + y1) / 2) * scale];
  pen.strokeStyle = ink("--blue");
  pen.lineWidth = 2;
  trace(pen, run.path.map(place));
  const [u, v] = place(run.path[now]);
  pen.fillStyle = ink("--orange");
  pen.beginPath();
  pen.arc(u, v, 6, 0, 2 * Math.PI);
  pen.fill();
  pen.strokeStyle = pen.fillStyle = ink("--faint");
  trace(pen, [[10, h - 10], [10 + scale, h - 10]]);
  pen.fillText("1 m", 12, h - 14);
}

function facts() {
  const track = run.eyes[eye];
  const texts = [["Time", run.t[now].toFixed(2) + " s"], ["Frame", String(run.frames[now])], ["Lane", track.status[now]], ["Pipeline", run.eyes[eye].words]];
  at("values").replaceChildren(...texts.map(([name, text]) => {
    const box = document.createElement("div");
    const [head, value] = [document.createElement("dt"), document.createElement("dd")];
    [head.textContent, value.textContent] = [name, text];
    box.append(head, value);
    return box;
  }));
}

function drawAll() {
  if (run) {
    if (playing) {
      const t = from + ((performance.now() - since) / 1000) * Number(at("rate").value);
      go(numberAt(t));
      if (t >= duration()) playing = false;
    }
    at("play").textContent = playing ? "Pause" : "Play";
    const key = [now, eye, at("map").clientWidth, canvases[0][0].clientWidth, window.devicePixelRatio, ink("--ink")].join();
    if (key !== drawn) {
      drawn = key;
      facts();
      PLOTS.forEach((what, i) => plot(canvases[i], what));
      drawMap();
    }
  }
  requestAnimationFrame(drawAll);
}

for (const [id, act] of [["play", toggle], ["back", () => step(-1)], ["on", () => step(1)], ["back-mark", () => mark(-1)], ["next-mark", () => mark(1)]]) {
  at(id).addEventListener("click", act);
}
at("rate").addEventListener("change", restart);
at("key").addEventListener("change", showValue);
at("try").addEventListener("click", tryChange);
at("value").addEventListener("keydown", (event) => { if (event.key === "Enter") tryChange(); });
document.addEventListener("keydown", (event) => {
  const act = { " ": toggle, n: () => mark(1), p: () => mark(-1) }[event.key.toLowerCase()];
  if (["SELECT", "INPUT"].includes(event.target.tagName) || event.ctrlKey || event.metaKey || event.altKey) return;
  if (act) act();
  else if (event.key === "ArrowLeft" || event.key === "ArrowRight") {
    const side = event.key === "ArrowRight" ? 1 : -1;
    if (event.shiftKey && run) jump(run.t[now] + side);
    else step(side);
  } else if (run && /^[1-9]$/.test(event.key)) choose(Object.keys(run.eyes)[Number(event.key) - 1]);
  else return;
  event.preventDefault();
});
connect();
requestAnimationFrame(drawAll);
