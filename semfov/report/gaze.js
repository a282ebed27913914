const data = JSON.parse(document.getElementById("data").textContent);
const SVG = "http://www.w3.org/2000/svg";
let picture = data.pictures[0];
let who = 0; // the number of a viewer; 0 for all
const steps = stepper({ last, show, word: () => "fixation", pause: 900, first: 0 });

function last() {
  const most = picture.maps.length - 1;
  return who ? Math.min(most, picture.paths[who - 1].length) : most;
}

for (const [number, each] of data.pictures.entries()) find("picture").add(new Option(each.name, number));
find("episode-choice").hidden = data.pictures.length < 2;

function drawn(kind, attributes) {
  const element = document.createElementNS(SVG, kind);
  for (const [name, value] of Object.entries(attributes)) element.setAttribute(name, value);
  find("drawing").append(element);
}

function drawHeat(step) {
  const canvas = find("map");
  canvas.hidden = !find("heat").checked;
  [canvas.height, canvas.width] = picture.cells;
  const bytes = Uint8Array.from(atob(picture.maps[step]), (letter) => letter.charCodeAt(0));
  const image = new ImageData(canvas.width, canvas.height);
  bytes.forEach((value, cell) => {
    const [red, green, blue, opacity] = data.heat[Math.round((value / 255) * (data.heat.length - 1))];
    image.data.set([red, green, blue, 255 * opacity], 4 * cell);
  });
  canvas.getContext("2d").putImageData(image, 0, 0);
}

function drawBorders(step) {
  if (!find("borders").checked) return;
  picture.borders[step].forEach((line, order) => {
    drawn("path", { d: line, class: "border under", "stroke-width": 2.5 + 2 * order });
    drawn("path", { d: line, class: "border", "stroke-width": 1 + 1.5 * order });
  });
}

function write(words, attributes) {
  drawn("text", attributes);
  find("drawing").lastChild.textContent = words;
}

function drawAreas() {
  if (!find("areas").checked) return;
  const unit = Math.max(...picture.size) / 250;
  for (const [words, left, top, right, bottom] of picture.areas) {
    drawn("rect", { class: "area", x: left, y: top, width: right - left, height: bottom - top });
    // Above the box, where it hides nothing of it, unless there is no room.
    const y = top > 10 * unit ? top - 2.5 * unit : top + 8 * unit;
    // To the side of the picture that has more room for a long name.
    const [x, anchor] = left + right < picture.size[0] ? [left, "start"] : [right, "end"];
    write(words, { x, y, "text-anchor": anchor, "font-size": 7 * unit, "stroke-width": unit });
  }
}

function drawFirst() {
  if (!find("paths").checked) return;
  const unit = Math.max(...picture.size) / 250;
  const d = "M" + picture.first.map((point) => point.join(",")).join("L");
  drawn("path", { d, class: "path", stroke: "#ffffff", "stroke-width": 3 });
  drawn("path", { d, class: "path", stroke: data.colours[0], "stroke-width": 1.5 });
  picture.first.forEach(([x, y], order) => {
    drawn("circle", { cx: x, cy: y, r: 6 * unit, fill: data.colours[0], stroke: "#ffffff", "stroke-width": unit / 2 });
    write(order + 1, { class: "order", x, y, "font-size": 8 * unit });
  });
}

function drawPaths(step) {
  if (!find("paths").checked) return;
  const unit = Math.max(...picture.size) / 250;
  picture.paths.forEach((points, viewer) => {
    if (who && viewer !== who - 1) return;
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
  const step = steps.at;
  const there = picture.paths.filter((points) => points.length >= step).length;
  const words = step
    ? `Where ${there} viewer${there > 1 ? "s" : ""} will look next, after ${step} fixation${step > 1 ? "s" : ""}`
    : "The first three fixations, and where most are";
  find("status").textContent = who ? `Viewer ${who}. ${words}` : words;
  find("drawing").replaceChildren();
  find("drawing").setAttribute("viewBox", `0 0 ${picture.size.join(" ")}`);
  find("drawing").setAttribute("aria-label", `${words} in ${picture.name}`);
  drawHeat(step);
  drawBorders(step);
  drawAreas();
  if (step) drawPaths(step);
  else drawFirst();
}

function choose(number) {
  picture = data.pictures[number];
  find("image").src = picture.image;
  find("image").alt = picture.name;
  find("image").parentElement.style.setProperty("--aspect", picture.size[0] / picture.size[1]);
  find("lead").textContent = picture.lead;
  find("areas").closest("label").hidden = !picture.areas.length;
  data.pictures.forEach((_, each) => (find(`facts-${each}`).hidden = each !== number));
  find("who").replaceChildren(new Option("all viewers", 0), ...picture.paths.map((_, n) => new Option(`viewer ${n + 1}`, n + 1)));
  follow(Math.min(who, picture.paths.length));
}

function follow(viewer) {
  find("who").value = who = viewer;
  steps.stop();
  steps.start(steps.at);
}

// A link of the overview leads to a picture, and so does an address of the page that names one.
function followLink() {
  const number = data.pictures.findIndex((_, each) => location.hash === `#facts-${each}`);
  if (number < 0) return;
  find("picture").value = number;
  choose(number);
  find("viewer").scrollIntoView();
}
window.addEventListener("hashchange", followLink);
find("picture").addEventListener("change", (event) => choose(Number(event.target.value)));
find("who").addEventListener("change", (event) => follow(Number(event.target.value)));
document.addEventListener("keydown", (event) => {
  const moves = { ArrowUp: who - 1, ArrowDown: who + 1 };
  // Lists and the slider use these keys themselves.
  if (!(event.key in moves) || event.target.closest("select, input, .wide") || event.altKey || event.ctrlKey || event.metaKey) return;
  event.preventDefault();
  follow(Math.min(Math.max(moves[event.key], 0), picture.paths.length));
});
for (const layer of ["heat", "borders", "areas", "paths"]) find(layer).addEventListener("change", show);
choose(0);
followLink();
