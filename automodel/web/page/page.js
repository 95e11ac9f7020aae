"use strict";
// The car's page: shows what the socket tells, says "stop", "arm", "take", "hold", "drive STEERING SPEED" and "release".
const HOLD_MS = 100; // the car stops when it has heard nothing of a held button for five times as long
const HAND_MS = 50; // between two words of a hand's steering and speed
const DRAG_PX = 110; // from where a finger came down to the full angle or speed
const DEAD = 0.08; // of a stick's way
const KEY_STEER_MS = 300; // from straight to the full angle by a key
const RECONNECT_MS = 1000;
const SHOWN_S = 30; // of the plots
const KEPT = 2400; // rows
const [T, OFFSET, BOUND, HEADING, STEERING, SPEED, LATENCY, X, Y] = [0, 1, 2, 3, 4, 5, 6, 7, 8]; // a row's columns
const DEG = 180 / Math.PI;
const PLOTS = [ // title, unit, column, factor, least span
  ["Offset, with its bound", "cm", OFFSET, 100, 10],
  ["Heading", "deg", HEADING, DEG, 10],
  ["Steering", "deg", STEERING, DEG, 10],
  ["Speed", "m/s", SPEED, 1, 0.5],
  ["Latency", "ms", LATENCY, 1, 20],
];
const at = (id) => document.getElementById(id);
let rows = [];
let yaw = 0;
let socket = null;
let holding = null; // the timer that says that a button is held
let drove = false; // whether the car drove since the button is held
let hand = null; // who drives by hand: {button, read}, read() gives shares of steering (left +) and speed
let pictureUrl = "";

const canvases = PLOTS.map(([title]) => {
  const box = document.createElement("div");
  const head = document.createElement("h2");
  const value = document.createElement("b");
  const canvas = document.createElement("canvas");
  canvas.setAttribute("aria-label", title);
  head.append(title, value);
  box.append(head, canvas);
  at("plots").append(box);
  return [canvas, value];
});

function say(word) {
  if (socket && socket.readyState === WebSocket.OPEN) socket.send(word);
}

function connect() {
  const token = location.hash.slice(1);
  if (!token) return offline("open the address that automodel run printed, with all that follows the #");
  socket = new WebSocket((location.protocol === "https:" ? "wss://" : "ws://") + location.host + "/socket");
  socket.binaryType = "blob";
  socket.onopen = () => socket.send(token);
  socket.onmessage = (event) => (typeof event.data === "string" ? told(JSON.parse(event.data)) : show(event.data));
  socket.onclose = (event) => {
    release();
    if (event.code === 4401) return offline("the token is wrong: open the address that automodel run printed");
    offline("no connection to the car");
    setTimeout(connect, RECONNECT_MS);
  };
}

function offline(reason) {
  at("mode").textContent = "offline";
  at("mode").dataset.mode = "offline";
  at("reason").textContent = reason;
  at("hold").disabled = at("take").disabled = true;
}

function show(picture) {
  const before = pictureUrl;
  pictureUrl = URL.createObjectURL(picture);
  at("picture").src = pictureUrl;
  if (before) URL.revokeObjectURL(before);
}

function told(news) {
  if (news.history) {
    rows = news.history;
    at("take").hidden = !news.by_hand;
    return;
  }
  rows.push(news.row);
  if (rows.length > KEPT) rows.splice(0, rows.length - KEPT);
  yaw = news.yaw_rad;
  at("hold").disabled = at("take").disabled = false;
  const driving = ["DRIVING", "HOLD"].includes(news.mode);
  at("driver").textContent = !driving ? "nobody" : news.by_hand ? "by hand" : "pipeline";
  if (holding === null) drove = false;
  else if (driving) drove = true;
  else if (drove) release(); // the car was stopped: the button has to be pressed anew
  at("mode").textContent = news.mode;
  at("mode").dataset.mode = news.mode;
  const stopped = news.mode === "STOPPED" ? news.events.filter((event) => event[1] === "stop").pop() : null;
  at("reason").textContent = news.reason || (stopped ? stopped[2] : "");
  at("lane").textContent = news.lane || "-";
  at("armed").textContent = [news.armed === null ? "silent" : news.armed ? "armed" : "disarmed", ...news.vehicle_faults].join(", ");
  at("battery").textContent = news.battery_v === null ? "-" : news.battery_v.toFixed(2) + " V" + (news.battery_low ? ", low" : "");
  at("battery").className = news.battery_low ? "bad" : "";
  at("camera").textContent = (news.rate_hz === null ? "-" : news.rate_hz.toFixed(1) + " Hz") + ", " + news.skipped + " skipped" +
    (news.unpaired === null ? "" : ", " + news.unpaired + " unpaired");
  listEvents(news.events);
}

let listed = "";
function listEvents(events) {
  const key = JSON.stringify(events);
  if (key === listed) return;
  listed = key;
  at("events").replaceChildren(...events.slice().reverse().map((event) => {
    const item = document.createElement("li");
    item.append(...[event[0].toFixed(2) + " s", event[1], event[2]].map((text) => {
      const span = document.createElement("span");
      span.textContent = text;
      return span;
    }));
    return item;
  }));
}

// --- drawing, once a picture of the screen

function plot([canvas, label], [, unit, column, factor, least]) {
  const [pen, w, h] = surface(canvas);
  const last = rows.length ? rows[rows.length - 1] : null;
  const shown = last ? rows.filter((row) => row[T] > last[T] - SHOWN_S) : [];
  const values = shown.map((row) => (row[column] === null ? null : row[column] * factor));
  const known = values.filter((value) => value !== null);
  label.textContent = last && last[column] !== null ? (last[column] * factor).toFixed(unit === "m/s" ? 2 : 1) + " " + unit : "-";
  if (!known.length) return;
  const middle = (Math.min(...known) + Math.max(...known)) / 2;
  const span = Math.max(least, (Math.max(...known) - Math.min(...known)) * 1.2);
  const x = (row) => w * (1 - (last[T] - row[T]) / SHOWN_S);
  const y = (value) => h * (0.5 - (value - middle) / span);
  pen.strokeStyle = ink("--rule");
  trace(pen, [[0, y(0)], [w, y(0)]]);
  if (column === OFFSET) {
    pen.strokeStyle = ink("--orange");
    for (const side of [1, -1]) {
      trace(pen, shown.map((row) => (row[OFFSET] === null || row[BOUND] === null ? null : [x(row), y(factor * (row[OFFSET] + side * row[BOUND]))])));
    }
  }
  pen.strokeStyle = ink("--blue");
  pen.lineWidth = 1.5;
  trace(pen, shown.map((row, i) => (values[i] === null ? null : [x(row), y(values[i])])));
  pen.fillStyle = ink("--faint");
  pen.fillText((middle + span / 2).toFixed(1), 2, 10);
  pen.fillText((middle - span / 2).toFixed(1), 2, h - 3);
}

function drawMap() {
  const [pen, w, h] = surface(at("map"));
  if (!rows.length) return;
  const xs = rows.map((row) => row[X]);
  const ys = rows.map((row) => row[Y]);
  const [x0, x1, y0, y1] = [Math.min(...xs), Math.max(...xs), Math.min(...ys), Math.max(...ys)];
  const scale = Math.min((w - 40) / Math.max(x1 - x0, 1), (h - 40) / Math.max(y1 - y0, 1));
  const place = (row) => [w / 2 + (row[X] - (x0 + x1) / 2) * scale, h / 2 - (row[Y] - (y0 + y1) / 2) * scale];
  pen.strokeStyle = ink("--blue");
  pen.lineWidth = 2;
  trace(pen, rows.map(place));
  const [u, v] = place(rows[rows.length - 1]);
  pen.save();
  pen.translate(u, v);
  pen.rotate(-yaw);
  pen.fillStyle = ink("--orange");
  pen.beginPath();
  pen.moveTo(9, 0);
  pen.lineTo(-6, 5);
  pen.lineTo(-6, -5);
  pen.fill();
  pen.restore();
  pen.strokeStyle = pen.fillStyle = ink("--faint");
  trace(pen, [[10, h - 10], [10 + scale, h - 10]]);
  pen.fillText("1 m", 12, h - 14);
}

let drawn = ""; // what is on the canvases
function drawAll() { // only what has changed: a phone has other things to do
  const newest = rows.length ? rows[rows.length - 1][T] : -1;
  const key = [newest, at("map").clientWidth, canvases[0][0].clientWidth, window.devicePixelRatio, ink("--ink")].join();
  if (key !== drawn) {
    drawn = key;
    PLOTS.forEach((what, i) => plot(canvases[i], what));
    drawMap();
  }
  requestAnimationFrame(drawAll);
}

// --- the operator

function press(event) {
  event.preventDefault();
  if (holding !== null || at("hold").disabled) return;
  at("hold").setPointerCapture(event.pointerId);
  at("hold").className = "held";
  say("arm");
  holding = setInterval(say, HOLD_MS, "hold");
}

function release() {
  if (holding === null) return;
  clearInterval(holding);
  holding = hand = null;
  at("hold").className = at("take").className = "";
  say("release");
}

// --- by hand: a finger on the button, a gamepad, the keyboard; whoever came first drives until they let go

function take(driver) {
  if (holding !== null || at("take").hidden || at("take").disabled) return false;
  hand = driver;
  at("take").className = "held";
  say("take");
  holding = setInterval(() => {
    const [steering, speed] = hand.read().map((share) => Math.max(-1, Math.min(1, share || 0)));
    say("drive " + steering.toFixed(3) + " " + speed.toFixed(3));
  }, HAND_MS);
  return true;
}

let finger = null;
at("take").addEventListener("pointerdown", (event) => {
  event.preventDefault();
  const [x, y] = [event.clientX, event.clientY];
  finger = [0, 0];
  if (!take({ name: "finger", read: () => finger })) return;
  at("take").setPointerCapture(event.pointerId);
  at("take").onpointermove = (moved) => { finger = [(x - moved.clientX) / DRAG_PX, (y - moved.clientY) / DRAG_PX]; };
});
for (const kind of ["pointerup", "pointercancel", "lostpointercapture"]) {
  at("take").addEventListener(kind, () => { if (hand && hand.name === "finger") release(); });
}
at("take").addEventListener("contextmenu", (event) => event.preventDefault());

const beyond = (share) => (Math.abs(share) < DEAD ? 0 : (share - Math.sign(share) * DEAD) / (1 - DEAD));
let shoulder = false; // whether the gamepad's button was down when it was looked at last
function lookAtGamepad() { // the standard layout; a pad has no events of its own
  const pad = [...navigator.getGamepads()].find((one) => one && one.connected && one.mapping === "standard");
  if (!pad) {
    shoulder = false;
    if (hand && hand.name === "gamepad") stop(); // it is gone
    return;
  }
  const down = pad.buttons[5].pressed;
  if (pad.buttons[0].pressed || pad.buttons[1].pressed) stop();
  else if (down && !shoulder) take({ name: "gamepad", read: readGamepad });
  else if (!down && hand && hand.name === "gamepad") release();
  shoulder = down;
}
function readGamepad() {
  const pad = [...navigator.getGamepads()].find((one) => one && one.connected && one.mapping === "standard");
  return pad ? [-beyond(pad.axes[0]), pad.buttons[7].value - pad.buttons[6].value] : [0, 0];
}
setInterval(lookAtGamepad, HAND_MS);

const keys = new Set();
let keySteering = 0;
const pressed = (...names) => Number(names.some((name) => keys.has(name)));
function readKeys() {
  const target = pressed("ArrowLeft", "KeyA") - pressed("ArrowRight", "KeyD");
  const step = (HAND_MS / KEY_STEER_MS) * (target !== 0 && target * keySteering >= 0 ? 1 : 2);
  keySteering += Math.max(-step, Math.min(step, target - keySteering));
  return [keySteering, pressed("ArrowUp", "KeyW") - pressed("ArrowDown", "KeyS")];
}
document.addEventListener("keydown", (event) => {
  keys.add(event.code);
  if (event.code === "ShiftLeft" && !event.repeat) {
    keySteering = 0;
    take({ name: "keyboard", read: readKeys });
  }
  if (hand && hand.name === "keyboard" && event.code.startsWith("Arrow")) event.preventDefault();
});
document.addEventListener("keyup", (event) => {
  keys.delete(event.code);
  if (event.code === "ShiftLeft" && hand && hand.name === "keyboard") release();
});
window.addEventListener("blur", () => keys.clear());

function stop() {
  say("stop");
  release();
}

at("hold").addEventListener("pointerdown", press);
for (const kind of ["pointerup", "pointercancel", "lostpointercapture"]) at("hold").addEventListener(kind, release);
at("hold").addEventListener("contextmenu", (event) => event.preventDefault());
window.addEventListener("blur", release);
document.addEventListener("visibilitychange", release);
at("stop").addEventListener("pointerdown", stop);
at("stop").addEventListener("click", stop);
document.addEventListener("keydown", (event) => {
  if (event.key === "Escape" || event.key === " ") {
    event.preventDefault();
    stop();
  }
});
at("hold").disabled = at("take").disabled = true;
connect();
requestAnimationFrame(drawAll);
