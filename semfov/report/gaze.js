"use strict";
const data = JSON.parse(document.getElementById("data").textContent);
const part = (name) => document.getElementById(name);
const SVG = "http://www.w3.org/2000/svg";
document.documentElement.classList.add("scripted");
let picture = data.pictures[0];
let step = 0;
let timer = null;

for (const [number, each] of data.pictures.entries()) part("picture").add(new Option(each.name, number));
part("episode-choice").hidden = data.pictures.length < 2;

function drawn(kind, attributes) {
  const element = document.createElementNS(SVG, kind);
  for (const [name, value] of Object.entries(attributes)) element.setAttribute(name, value);
  part("drawing").append(element);
}

function drawHeat() {
  const canvas = part("map");
  canvas.hidden = !part("heat").checked;
  [canvas.height, canvas.width] = picture.cells;
  const bytes = Uint8Array.from(atob(picture.maps[step]), (letter) => letter.charCodeAt(0));
  const image = new ImageData(canvas.width, canvas.height);
  bytes.forEach((value, cell) => {
    const [red, green, blue, opacity] = data.heat[Math.round((value / 255) * (data.heat.length - 1))];
    image.data.set([red, green, blue, 255 * opacity], 4 * cell);
  });
  canvas.getContext("2d").putImageData(image, 0, 0);
}

function drawContours() {
  if (!part("contours").checked) return;
  picture.contours[step].forEach((line, order) => {
    drawn("path", { d: line, class: "contour under", "stroke-width": 3 + order });
    drawn("path", { d: line, class: "contour", "stroke-width": 1 + order });
  });
}

function drawPaths() {
  if (!part("paths").checked) return;
  const unit = Math.max(...picture.size) / 250;
  picture.paths.forEach((points, viewer) => {
    const colour = data.colours[viewer % data.colours.length];
    const seen = points.slice(0, step);
    if (!seen.length) return;
    const dashes = ["", "5 3", "1 3"][Math.floor(viewer / data.colours.length) % 3];
    const d = "M" + seen.map((point) => point.join(",")).join("L");
    drawn("path", { d, class: "path", stroke: "#ffffff", "stroke-width": 2.6, "stroke-opacity": 0.6 });
    drawn("path", { d, class: "path", stroke: colour, "stroke-width": 1.4, "stroke-dasharray": dashes });
    seen.forEach(([x, y], order) => {
      const now = order === step - 1;
      drawn("circle", { cx: x, cy: y, r: now ? 2 * unit : unit, fill: colour, stroke: "#ffffff", "stroke-width": unit / 3 });
    });
  });
}

function show() {
  const most = picture.maps.length - 1;
  part("fixation").max = most;
  part("fixation").value = step;
  part("number").textContent = `${step} of ${most}`;
  part("back").disabled = step === 0;
  part("forward").disabled = step === most;
  const there = picture.paths.filter((points) => points.length >= step).length;
  const words = step
    ? `Density of the next fixation after ${step} fixation${step > 1 ? "s" : ""}, the mean of ${there} viewers`
    : "Density of all fixations";
  part("status").textContent = words;
  part("drawing").replaceChildren();
  part("drawing").setAttribute("viewBox", `0 0 ${picture.size.join(" ")}`);
  part("drawing").setAttribute("aria-label", `${words} in ${picture.name}`);
  drawHeat();
  drawContours();
  drawPaths();
}

function choose(number) {
  picture = data.pictures[number];
  step = Math.min(step, picture.maps.length - 1);
  part("image").src = picture.image;
  part("image").alt = picture.name;
  data.pictures.forEach((_, each) => (part(`facts-${each}`).hidden = each !== number));
  show();
}

function go(to) {
  step = Math.max(0, Math.min(to, picture.maps.length - 1));
  show();
}

function pause() {
  clearInterval(timer);
  timer = null;
  part("play").textContent = "Play";
}

function play() {
  if (timer !== null) return pause();
  if (step === picture.maps.length - 1) go(0);
  part("play").textContent = "Pause";
  timer = setInterval(() => {
    go(step + 1);
    if (step === picture.maps.length - 1) pause();
  }, 900);
}

part("picture").addEventListener("change", (event) => choose(Number(event.target.value)));
part("fixation").addEventListener("input", (event) => go(Number(event.target.value)));
part("back").addEventListener("click", () => go(step - 1));
part("forward").addEventListener("click", () => go(step + 1));
part("play").addEventListener("click", play);
for (const layer of ["heat", "contours", "paths"]) part(layer).addEventListener("change", show);
document.addEventListener("keydown", (event) => {
  if (["SELECT", "INPUT"].includes(event.target.tagName) || event.ctrlKey || event.metaKey || event.altKey) return;
  const to = { ArrowLeft: step - 1, ArrowRight: step + 1, Home: 0, End: picture.maps.length - 1 }[event.key];
  if (to === undefined) return;
  event.preventDefault();
  go(to);
});
choose(0);
