// The picture as the fovea sees it from the pointer, with the looks so far; a click asks for a look.
// Gradio gives `element`, `props`, `trigger` and `watch`. Coordinates are pixels of the picture.
const canvas = element.querySelector("canvas"), drawing = element.querySelector("svg");
const REACH = 4, STEPS = 32; // widths of a window after which nothing of it is left, and its steps
const GAZE = "#0072B2", ADVICE = "#D55E00", BOX = "#56B4E9";
let scene = null, levels = [], point = [0, 0], asked = false;
const layer = document.createElement("canvas");

function picture(uri) {
  const image = new Image();
  image.onload = ask;
  image.src = uri;
  return image;
}

function open() {
  scene = props.value ? JSON.parse(props.value) : null;
  drawing.replaceChildren();
  canvas.hidden = !scene;
  if (!scene) return;
  levels = scene.levels.map(picture);
  [canvas.width, canvas.height] = scene.pixels.map((side) => 2 * side);
  [layer.width, layer.height] = [canvas.width, canvas.height];
  point = scene.size.map((side) => side / 2);
  // The whole picture is on the screen, below what stands above it.
  canvas.parentElement.style.maxWidth = `calc((100vh - 17rem) * ${scene.size[0] / scene.size[1]})`;
  drawing.setAttribute("viewBox", `0 0 ${scene.size[0]} ${scene.size[1]}`);
}

// Many moves of the pointer come between two pictures on the screen.
function ask() {
  if (asked) return;
  asked = true;
  requestAnimationFrame(() => { asked = false; look(); });
}

// R = sum_k (w_k - w_k-1) G_k, which is the pyramid put together with the window w_k in its band k (`foveate`).
function look() {
  if (!scene || !levels.every((level) => level.complete)) return;
  const context = canvas.getContext("2d"), over = layer.getContext("2d");
  context.clearRect(0, 0, canvas.width, canvas.height);
  context.globalCompositeOperation = "lighter";
  levels.forEach((level, k) => {
    over.globalCompositeOperation = "copy";
    whole(over, level);
    over.globalCompositeOperation = "destination-in";
    mask(over, k);
    context.drawImage(layer, 0, 0);
  });
  context.globalCompositeOperation = "destination-over"; // below what rounding has left transparent
  whole(context, levels.at(-1));
}

function whole(context, level) {
  context.imageSmoothingQuality = "high";
  context.drawImage(level, 0, 0, canvas.width, canvas.height);
}

// The window of band k, of which the coarsest level has all, at a distance in widths of the finest one.
function windowAt(k, distance) {
  if (k < 0) return 0;
  return k === levels.length - 1 ? 1 : Math.exp(-0.5 * (distance / scene.growth ** k) ** 2);
}

function mask(context, k) {
  const unit = canvas.width / scene.size[0];
  const [x, y] = point.map((side) => side * unit);
  const wider = scene.growth ** Math.min(k, levels.length - 2);
  const [width, height] = scene.sigma.map((side) => side * unit * wider);
  const gradient = context.createRadialGradient(0, 0, 0, 0, 0, REACH);
  for (let step = 0; step <= STEPS; step++) {
    const distance = REACH * step / STEPS * wider;
    const weight = Math.max(0, windowAt(k, distance) - windowAt(k - 1, distance));
    gradient.addColorStop(step / STEPS, `rgb(0 0 0 / ${weight.toFixed(4)})`);
  }
  context.save();
  context.translate(x, y);
  context.scale(width, height);
  context.fillStyle = gradient;
  const far = 2 * Math.max(canvas.width, canvas.height) / Math.min(width, height);
  context.fillRect(-far, -far, 2 * far, 2 * far);
  context.restore();
}

function shape(tag, attributes, text = "") {
  const made = document.createElementNS("http://www.w3.org/2000/svg", tag);
  for (const [name, value] of Object.entries(attributes)) made.setAttribute(name, value);
  made.textContent = text;
  drawing.append(made);
}

function mark() {
  drawing.replaceChildren();
  const marks = props.marks ? JSON.parse(props.marks) : null;
  if (!scene || !marks) return;
  const unit = 11 * scene.size[0] / (canvas.clientWidth || 600); // radius of a mark, in 11 pixels of the screen
  const [columns, rows] = marks.grid;
  const width = scene.size[0] / columns, height = scene.size[1] / rows, most = Math.max(...marks.belief) || 1;
  marks.belief.forEach((belief, cell) => {
    const place = { x: (cell % columns) * width, y: Math.floor(cell / columns) * height, width, height };
    shape("rect", { ...place, class: "belief", fill: ADVICE, "fill-opacity": (0.6 * belief / most).toFixed(3) });
  });
  for (const [x1, y1, x2, y2] of marks.boxes) {
    const box = { x: x1, y: y1, width: x2 - x1, height: y2 - y1, fill: "none" };
    shape("rect", { ...box, stroke: "white", "stroke-width": 0.3 * unit });
    shape("rect", { ...box, stroke: BOX, "stroke-width": 0.15 * unit });
  }
  const line = { points: marks.looks.map((each) => each.join()).join(" "), fill: "none" };
  shape("polyline", { ...line, stroke: "white", "stroke-width": 0.35 * unit });
  shape("polyline", { ...line, stroke: GAZE, "stroke-width": 0.2 * unit });
  if (marks.next) {
    const ring = { cx: marks.next[0], cy: marks.next[1], r: 1.2 * unit, fill: "none" };
    shape("circle", { ...ring, stroke: "white", "stroke-width": 0.45 * unit });
    shape("circle", { ...ring, stroke: ADVICE, "stroke-width": 0.3 * unit });
  }
  marks.looks.forEach(([x, y], number) => {
    shape("circle", { cx: x, cy: y, r: unit, fill: GAZE, stroke: "white", "stroke-width": 0.15 * unit });
    const words = { x, y, fill: "white", "font-size": 1.3 * unit, "text-anchor": "middle", "dominant-baseline": "central" };
    shape("text", words, String(number));
  });
}

function follow(event) {
  if (!scene) return;
  const frame = canvas.getBoundingClientRect();
  point = [(event.clientX - frame.left) / frame.width * scene.size[0], (event.clientY - frame.top) / frame.height * scene.size[1]];
  ask();
}

function step(event) {
  const moves = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
  if (event.key === "Enter") return select();
  if (!scene || !moves[event.key]) return;
  event.preventDefault();
  point = point.map((side, axis) => Math.min(Math.max(side + moves[event.key][axis] * scene.size[axis] / 20, 0), scene.size[axis] - 1));
  ask();
}

function select() {
  if (scene) trigger("select", { index: point });
}

canvas.addEventListener("pointermove", follow);
canvas.addEventListener("click", (event) => { follow(event); select(); });
canvas.addEventListener("keydown", step);
watch("value", () => { open(); mark(); });
watch("marks", mark);
open();
mark();
