"use strict";
// What all pages draw with.
const ink = (name) => getComputedStyle(document.documentElement).getPropertyValue(name);

function surface(canvas) {
  const ratio = window.devicePixelRatio || 1;
  const [w, h] = [canvas.clientWidth, canvas.clientHeight];
  if (canvas.width !== Math.round(w * ratio) || canvas.height !== Math.round(h * ratio)) {
    canvas.width = Math.round(w * ratio);
    canvas.height = Math.round(h * ratio);
  }
  const pen = canvas.getContext("2d");
  pen.setTransform(ratio, 0, 0, ratio, 0, 0);
  pen.clearRect(0, 0, w, h);
  pen.font = "11px system-ui, sans-serif";
  return [pen, w, h];
}

function trace(pen, points) { // a gap where a point is null
  let open = false;
  pen.beginPath();
  for (const point of points) {
    if (point && open) pen.lineTo(...point);
    if (point && !open) pen.moveTo(...point);
    open = Boolean(point);
  }
  pen.stroke();
}
