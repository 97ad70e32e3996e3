"use strict";
const data = JSON.parse(document.getElementById("data").textContent);
const colour = name => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
let INK, SOFT, GRID, OPEN, CLOSED;
function readColours() {
  [INK, SOFT, GRID, OPEN, CLOSED] = ["--ink", "--soft", "--line", "--open", "--closed"].map(colour);
}
const view = {turn: -0.9, tilt: 0.6, zoom: 1};
const [low, high] = data.bounds, middle = low.map((v, i) => (v + high[i]) / 2);
const floorFrom = i => Math.floor(low[i] / data.grid) * data.grid, floorTo = i => Math.ceil(high[i] / data.grid) * data.grid;
const corners = [floorFrom(0), floorTo(0)].flatMap(x => [floorFrom(1), floorTo(1)].flatMap(y => [low[2], high[2]].map(z => [x, y, z])));

function flat(p, turn, tilt) {
  const [x, y, z] = p.map((v, i) => v - middle[i]);
  const right = Math.cos(turn) * x - Math.sin(turn) * y, away = Math.sin(turn) * x + Math.cos(turn) * y;
  return [right, -Math.sin(tilt) * away - Math.cos(tilt) * z];
}

// One scale for all directions, so that the size does not change while the view turns.
const extent = [0, 1].map(i => Math.max(...corners.map(p => Math.abs(flat(p, view.turn, view.tilt)[i]))));

function projector(canvas) {
  const scale = view.zoom * 0.46 * Math.min(canvas.width / extent[0], canvas.height / extent[1]);
  return p => flat(p, view.turn, view.tilt).map((v, i) => scale * v + [canvas.width, canvas.height][i] / 2);
}

function line(pen, points, colour, width) {
  pen.strokeStyle = colour; pen.lineWidth = width; pen.beginPath();
  points.forEach((p, i) => i ? pen.lineTo(...p) : pen.moveTo(...p));
  pen.stroke();
}

function floor(pen, at, unit) {
  const step = data.grid, z = low[2];
  const from = floorFrom, to = floorTo;
  for (let x = from(0); x <= to(0) + 1e-9; x += step) line(pen, [at([x, from(1), z]), at([x, to(1), z])], GRID, unit);
  for (let y = from(1); y <= to(1) + 1e-9; y += step) line(pen, [at([from(0), y, z]), at([to(0), y, z])], GRID, unit);
  const corner = [from(0), from(1), z];
  pen.font = `${11 * unit}px system-ui,sans-serif`; pen.fillStyle = SOFT; pen.textAlign = "center";
  ["x", "y", "z"].forEach((name, i) => {
    const tip = corner.slice(); tip[i] += step;
    const label = corner.slice(); label[i] += step * 1.35;
    line(pen, [at(corner), at(tip)], SOFT, 1.5 * unit);
    const [u, v] = at(label); pen.fillText(name, u, v + 4 * unit);
  });
}

function path(pen, at, arm, unit, width) {
  const points = arm.points.map(at);
  line(pen, arm.points.map(p => at([p[0], p[1], low[2]])), GRID, width * unit);
  for (let i = 1; i < points.length; i++)
    line(pen, [points[i - 1], points[i]], arm.closed[i - 1] ? CLOSED : OPEN, width * unit);
  const r = 2 * width * unit, [a, b] = [points[0], points[points.length - 1]];
  pen.fillStyle = arm.closed[0] ? CLOSED : OPEN; pen.beginPath(); pen.arc(...a, r, 0, 7); pen.fill();
  pen.fillStyle = arm.closed[arm.closed.length - 1] ? CLOSED : OPEN; pen.fillRect(b[0] - r, b[1] - r, 2 * r, 2 * r);
}

function gripper(pen, at, arm, step, unit) {
  const [point, left, right] = arm.grippers[step].map(at);
  pen.lineCap = "round";
  line(pen, [left, point, right, left], INK, 2.2 * unit);
  pen.fillStyle = INK; pen.beginPath(); pen.arc(...point, 3.2 * unit, 0, 7); pen.fill();
}

function fit(canvas) {
  const unit = window.devicePixelRatio || 1;
  canvas.width = Math.max(1, Math.round(canvas.clientWidth * unit));
  canvas.height = Math.max(1, Math.round(canvas.clientHeight * unit));
  return unit;
}

function draw(canvas, episodes, step) {
  const unit = fit(canvas), pen = canvas.getContext("2d"), at = projector(canvas);
  pen.lineJoin = pen.lineCap = "round";
  floor(pen, at, unit);
  for (const episode of episodes)
    for (const arm of episode.arms) {
      path(pen, at, arm, unit, episodes.length > 1 ? 1.4 : 2.4);
      if (step !== undefined) gripper(pen, at, arm, step, unit);
    }
}

const cards = [...document.querySelectorAll(".episode")].map((card, index) => {
  const episode = data.episodes[index], video = card.querySelector("video");
  const self = {canvas: card.querySelector("canvas"), episode, step: 0};
  const needle = card.querySelector(".needle"), now = card.querySelector(".now"), strip = card.querySelector(".time svg");
  self.draw = () => draw(self.canvas, [episode], self.step);
  self.show = share => {
    self.step = Math.round(share * (episode.arms[0].points.length - 1));
    needle.setAttribute("transform", `translate(${share * 1000} 0)`);
    now.textContent = `${(share * episode.seconds).toFixed(2)} s of ${episode.seconds.toFixed(2)} s`;
    self.draw();
  };
  const scrub = event => {
    const box = strip.getBoundingClientRect();
    const share = Math.min(1, Math.max(0, (event.clientX - box.left) / box.width));
    if (video) { video.pause(); video.currentTime = share * episode.seconds; }
    self.show(share);
  };
  strip.addEventListener("pointerdown", event => { strip.setPointerCapture(event.pointerId); scrub(event); });
  strip.addEventListener("pointermove", event => { if (event.buttons) scrub(event); });
  if (video) {
    const follow = () => {
      self.show(Math.min(1, video.currentTime / episode.seconds));
      if (!video.paused) requestAnimationFrame(follow);
    };
    video.addEventListener("play", follow);
  }
  return self;
});

const all = document.getElementById("all");
function drawAll() { readColours(); draw(all, data.episodes); cards.forEach(card => card.draw()); }
for (const canvas of [all, ...cards.map(card => card.canvas)]) {
  let last = null;
  canvas.addEventListener("pointerdown", event => { last = event; canvas.setPointerCapture(event.pointerId); });
  canvas.addEventListener("pointerup", () => { last = null; });
  canvas.addEventListener("pointermove", event => {
    if (!last) return;
    view.turn += (event.clientX - last.clientX) * 0.01;
    view.tilt = Math.min(1.57, Math.max(0, view.tilt + (event.clientY - last.clientY) * 0.01));
    last = event;
    requestAnimationFrame(drawAll);
  });
  canvas.addEventListener("wheel", event => {
    event.preventDefault();
    view.zoom = Math.min(8, Math.max(0.4, view.zoom * Math.exp(-event.deltaY * 0.001)));
    requestAnimationFrame(drawAll);
  }, {passive: false});
}
window.addEventListener("resize", drawAll);
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", drawAll);
readColours();
cards.forEach(card => card.show(0));
drawAll();
