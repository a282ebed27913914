(() => {
  const report = JSON.parse(document.getElementById("data").textContent);
  const GAZE = "#0072B2", TARGET = "#B84700", FOUND = "#00795A", OTHER = "#1F4E79", TRUTH = "#E69F00";
  let episode, fixation = 0, chosenClass = 0, wantedClass = null;

  // Elements: names and texts are set as text, never as markup.
  function make(namespace, tag, attributes = {}, children = []) {
    const element = document.createElementNS(namespace, tag);
    for (const [name, value] of Object.entries(attributes)) element.setAttribute(name, value);
    for (const child of [].concat(children)) element.append(child);
    return element;
  }
  const svg = (tag, attributes, children) => make("http://www.w3.org/2000/svg", tag, attributes, children);
  const html = (tag, attributes, children) => make("http://www.w3.org/1999/xhtml", tag, attributes, children);

  // Data.
  const bytes = (text) => Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
  function decode(map) {
    if (!map.bytes) map.bytes = bytes(map.data);
    return map;
  }
  const cells = () => episode.grid[0] * episode.grid[1];
  function mapValues(map) {
    const { bytes: steps, max } = decode(map);
    return Array.from(steps.subarray(fixation * cells(), (fixation + 1) * cells()), (step) => step / 255 * max);
  }
  // Episodes in large pictures have looks. Their pictures and tables are in the page, and need only be chosen.
  const steps = () => episode.looks ?? episode.fixations;
  const word = () => episode.looks ? "look" : "fixation";
  const short = (value) => value === null ? "none" : Number(value.toPrecision(3)).toString();
  const place = (cell) => `column ${cell % episode.grid[0]}, row ${Math.floor(cell / episode.grid[0])}`;
  function colour(scale, share) {
    const steps = report.colours[scale];
    const at = Math.min(Math.max(share, 0), 1) * (steps.length - 1);
    const low = Math.floor(at), high = Math.min(low + 1, steps.length - 1);
    const [r, g, b, opacity] = steps[low].map((value, n) => value + (steps[high][n] - value) * (at - low));
    return { fill: `rgb(${[r, g, b].map(Math.round).join(" ")})`, "fill-opacity": Number(opacity.toFixed(3)) };
  }

  // Pictures. Coordinates are pixels of the photograph; one unit is a 640th of its width.
  const unit = () => episode.size[0] / 640;
  function frame(id, picture, label, grey = false) {
    const target = find(id);
    target.setAttribute("viewBox", `0 0 ${episode.size[0]} ${episode.size[1]}`);
    target.setAttribute("aria-label", label);
    target.replaceChildren();
    if (picture !== null) {
      const source = { href: report.pictures[picture], width: episode.size[0], height: episode.size[1], preserveAspectRatio: "none", class: grey ? "grey" : "" };
      if (id === "path") source.id = "episode-picture"; // of which the list of objects shows parts
      target.append(svg("image", source));
    }
    return target;
  }
  function box([x1, y1, x2, y2], attributes) {
    return svg("rect", { x: x1, y: y1, width: Math.max(x2 - x1, 0), height: Math.max(y2 - y1, 0), fill: "none", ...attributes });
  }
  function cellBox(cell) {
    const width = episode.size[0] / episode.grid[0], height = episode.size[1] / episode.grid[1];
    const column = cell % episode.grid[0], row = Math.floor(cell / episode.grid[0]);
    return [column * width, row * height, (column + 1) * width, (row + 1) * height];
  }
  function middle(cell) {
    const [x1, y1, x2, y2] = cellBox(cell);
    return [(x1 + x2) / 2, (y1 + y2) / 2];
  }
  function cross(cell) {
    const [x, y] = middle(cell), r = 11 * unit();
    const line = `M${x - r} ${y}H${x + r}M${x} ${y - r}V${y + r}`;
    return [svg("path", { d: line, stroke: "white", "stroke-width": 6 * unit() }), svg("path", { d: line, stroke: GAZE, "stroke-width": 3 * unit() })];
  }

  function drawPath() {
    const visited = episode.fixations.slice(0, fixation + 1).map((each) => each.cell);
    const target = frame("path", episode.image, `Photograph with fixations 0 to ${fixation}, now at ${place(visited[fixation])}`);
    for (const truth of episode.truth) target.append(box(truth, { stroke: TRUTH, "stroke-width": 3 * unit(), "stroke-dasharray": `${8 * unit()} ${5 * unit()}` }));
    if (episode.outcome.box !== null && fixation === episode.fixations.length - 1) {
      const dashes = episode.found ? "none" : `${8 * unit()} ${5 * unit()}`; // the best place of a search that leaves it open
      target.append(box(episode.outcome.box, { stroke: "white", "stroke-width": 5 * unit() }), box(episode.outcome.box, { stroke: FOUND, "stroke-width": 3 * unit(), "stroke-dasharray": dashes }));
    }
    // Colours go from dark to bright over the whole episode, however much of it is shown.
    const last = Math.max(episode.fixations.length - 1, 1);
    const when = (number) => colour("time", number / last).fill;
    const points = visited.map(middle);
    points.slice(1).forEach(([x2, y2], number) => {
      const [x1, y1] = points[number], ends = { x1, y1, x2, y2 };
      target.append(svg("line", { ...ends, stroke: "white", "stroke-width": 3.4 * unit(), "stroke-opacity": 0.7 }));
      target.append(svg("line", { ...ends, stroke: when(number + 1), "stroke-width": 1.8 * unit() }));
    });
    points.forEach(([x, y], number) => {
      const end = episode.found && number === episode.fixations.length - 1;
      target.append(svg("circle", { cx: x, cy: y, r: 14 * unit(), fill: when(number), stroke: end ? FOUND : "white", "stroke-width": (number === fixation ? 4 : 1.5) * unit() }));
      target.append(svg("text", { x, y, fill: number / last > 0.6 ? "black" : "white", "font-size": 18 * unit(), "font-weight": "bold", "text-anchor": "middle", "dominant-baseline": "central" }, String(number + 1)));
    });
  }

  function drawView() {
    const now = episode.fixations[fixation];
    const target = frame("view", now.view, `Foveated view from ${place(now.cell)} with ${now.detections.length} detections`);
    const tags = [];
    now.detections.forEach((detection, number) => {
      const shade = detection.label === episode.target ? TARGET : OTHER;
      target.append(box(detection.box, { stroke: "white", "stroke-width": 4 * unit() }));
      target.append(box(detection.box, { stroke: shade, "stroke-width": 2.5 * unit() }));
      const [x1, y1, x2, y2] = detection.tag;
      tags.push(box(detection.tag, { fill: shade }));
      tags.push(svg("text", { x: x1 + 4 * unit(), y: (y1 + y2) / 2, fill: "white", "font-size": 19 * unit(), "dominant-baseline": "central", textLength: x2 - x1 - 8 * unit(), lengthAdjust: "spacingAndGlyphs" }, `${number + 1} ${detection.label}`));
    });
    target.append(...tags, ...cross(now.cell));
  }

  function drawMap(id, values, low, high, scale, label) {
    const target = frame(id, episode.image, label, true);
    const readout = drawScale(`${id}-scale`, low, high, scale);
    values.forEach((value, cell) => {
      const share = value === null ? 0 : (value - low) / (high - low || 1);
      const shade = value === null ? { fill: "#777777", "fill-opacity": 0.82 } : colour(scale, share);
      const square = box(cellBox(cell), { ...shade, stroke: "white", "stroke-width": 0.6 * unit(), "stroke-opacity": 0.5 });
      const tell = () => { readout.textContent = `${place(cell)}: ${short(value)}`; };
      square.addEventListener("pointerenter", tell);
      square.addEventListener("pointerdown", tell);
      target.append(square);
    });
    return target;
  }
  function drawScale(id, low, high, scale) {
    const stops = report.colours[scale].map(([r, g, b, opacity]) => `rgb(${r} ${g} ${b} / ${opacity})`).join(", ");
    const bar = html("i");
    bar.style.backgroundImage = `linear-gradient(90deg, ${stops})`;
    const readout = html("span");
    find(id).replaceChildren(html("span", {}, short(low)), bar, html("span", {}, short(high)), readout);
    return readout;
  }
  const bestOf = (values) => values.reduce((best, value, cell) => value !== null && (values[best] === null || value > values[best]) ? cell : best, 0);

  function drawBelief() {
    const map = episode.maps[chosenClass], values = mapValues(map), best = bestOf(values);
    // One scale from 0 to 1 for all classes and fixations.
    drawMap("belief", values, 0, 1, "overlay", `Probability of ${map.label}: highest ${short(values[best])} at ${place(best)}`)
      .append(...cross(episode.fixations[fixation].cell));
    return `Probability of ${map.label} is highest at ${place(best)}: ${short(values[best])}.`;
  }
  function drawEntropy() {
    const values = mapValues(episode.entropy), best = bestOf(values);
    const low = Math.min(...decode(episode.entropy).bytes) / 255 * episode.entropy.max;
    drawMap("entropy", values, low, episode.entropy.max, "uncertainty", `Entropy: highest ${short(values[best])} bits at ${place(best)}`)
      .append(...cross(episode.fixations[fixation].cell));
  }
  function drawValues() {
    const now = episode.fixations[fixation], known = now.values.filter((value) => value !== null);
    const low = Math.min(...known), high = Math.max(...known);
    const chosen = now.next === null ? "no cell chosen" : `chosen: ${place(now.next)}`;
    const target = drawMap("values", now.values, low, high, "probability", `Acquisition values, ${chosen}`);
    for (const { cell } of episode.fixations.slice(0, fixation + 1)) {
      const [x, y] = middle(cell), r = 9 * unit();
      const line = `M${x - r} ${y - r}L${x + r} ${y + r}M${x + r} ${y - r}L${x - r} ${y + r}`;
      target.append(svg("path", { d: line, stroke: "black", "stroke-width": 6 * unit() }), svg("path", { d: line, stroke: "white", "stroke-width": 3 * unit() }));
    }
    if (now.next !== null) {
      target.append(box(cellBox(now.next), { stroke: "black", "stroke-width": 9 * unit() }), box(cellBox(now.next), { stroke: "#FF8F4D", "stroke-width": 5 * unit() }));
    }
  }

  // Tables.
  const row = (tag, values) => html("tr", {}, values.map((value) => html(tag, {}, String(value))));
  function listDetections() {
    const now = episode.fixations[fixation].detections, table = find("detections");
    if (!now.length) return table.replaceChildren(row("td", ["no detections"]));
    const most = Math.max(...now.map((detection) => detection.scores.length));
    const heads = Array.from({ length: most }, (_, number) => `class ${number + 1}`);
    const rows = now.map((detection, number) => row("td", [number + 1, ...detection.scores.map(([name, score]) => `${name} ${(score ?? 0).toFixed(3)}`)]));
    table.replaceChildren(html("thead", {}, row("th", ["#", ...heads])), html("tbody", {}, rows));
  }
  function listSeconds() {
    const timed = episode.fixations.every((each) => each.seconds !== null);
    find("timing").hidden = !timed;
    if (!timed) return;
    const stages = [...new Set(episode.fixations.flatMap((each) => Object.keys(each.seconds)))];
    const mean = (stage) => episode.fixations.reduce((sum, each) => sum + (each.seconds[stage] ?? 0), 0) / episode.fixations.length;
    const longest = Math.max(...stages.map((stage) => episode.fixations[fixation].seconds[stage] ?? 0)) || 1;
    const rows = stages.map((stage) => {
      const seconds = episode.fixations[fixation].seconds[stage] ?? 0, bar = html("i");
      bar.style.width = `${100 * seconds / longest}%`;
      const figure = (value) => html("td", { class: "number" }, `${(1000 * value).toFixed(2)} ms`);
      return html("tr", {}, [html("th", { scope: "row" }, stage), figure(seconds), figure(mean(stage)), html("td", { class: "bar" }, bar)]);
    });
    const head = html("tr", {}, [html("th", {}, "stage"), html("th", { class: "number" }, "this fixation"), html("th", { class: "number" }, "mean"), html("td")]);
    find("seconds").replaceChildren(html("thead", {}, head), html("tbody", {}, rows));
  }

  function showLook() {
    const now = episode.looks[fixation], article = find(episode.article);
    for (const look of article.querySelectorAll(".look")) look.hidden = Number(look.dataset.look) !== fixation;
    for (const drawn of article.querySelectorAll("g[data-look]")) {
      drawn.classList.toggle("now", Number(drawn.dataset.look) === fixation);
      drawn.classList.toggle("later", control.stepped && Number(drawn.dataset.look) > fixation);
    }
    const frames = [box(now.box, { class: "under" }), box(now.box, { class: "over" })];
    article.querySelector(".chosen").replaceChildren(...frames);
    find("status").textContent = now.status;
  }

  // Controls.
  function show() {
    fixation = control.at;
    if (episode.looks) showLook();
    else showFixation(steps().length - 1);
  }
  function showFixation(last) {
    const now = episode.fixations[fixation];
    drawPath();
    drawView();
    const believed = drawBelief();
    drawEntropy();
    drawValues();
    listDetections();
    listSeconds();
    const labels = now.detections.map((detection) => detection.label), times = (label) => labels.filter((each) => each === label).length;
    const seen = [...new Set(labels)].map((label) => `${times(label)} × ${label}`).join(", ") || "nothing";
    const sure = episode.presence === null ? "" : ` Probability that “${episode.target}” is in the picture: ${(episode.presence[fixation] ?? 0).toFixed(2)}.`;
    const end = fixation === last ? ` The end: ${episode.summary}.` : "";
    find("status").textContent = `At ${place(now.cell)}, the eye saw: ${seen}. ${believed}${sure}${end}`;
  }
  function open(number) {
    if (episode?.maps) wantedClass = episode.maps[chosenClass].label;
    episode = report.episodes[number];
    find("episode-views").hidden = Boolean(episode.looks);
    for (const article of document.querySelectorAll(".large, .of-episode")) article.hidden = article.id !== episode.article;
    if (episode.maps) {
      chosenClass = Math.max(0, episode.maps.findIndex((map) => map.label === wantedClass));
      find("class").replaceChildren(...episode.maps.map((map, index) => html("option", { value: index }, map.label)));
      find("class").value = chosenClass;
    }
    find("back").setAttribute("aria-label", `Previous ${word()}`);
    find("forward").setAttribute("aria-label", `Next ${word()}`);
    for (const told of document.querySelectorAll("[data-about]")) {
      told.parentElement.hidden = !episode[told.dataset.about];
      told.textContent = episode[told.dataset.about] ?? "";
    }
    control.start();
  }

  if (!report.episodes.length) {
    find("viewer").hidden = true;
    return;
  }
  const control = stepper({ last: () => steps().length - 1, show, word, pause: 1000 });
  find("episode-choice").hidden = report.episodes.length < 2;
  find("episode").replaceChildren(...report.episodes.map((each, index) => html("option", { value: index }, `${each.name}: ${each.summary}`)));
  find("episode").addEventListener("change", (event) => { control.stop(); open(Number(event.target.value)); });
  // A link of the overview leads to a picture, and so does an address of the page that names one.
  function follow() {
    const number = report.episodes.findIndex((each) => `#${each.article}` === location.hash);
    if (number < 0) return;
    control.stop();
    find("episode").value = number;
    open(number);
    find("viewer").scrollIntoView();
  }
  window.addEventListener("hashchange", follow);
  find("class").addEventListener("change", (event) => { chosenClass = Number(event.target.value); show(); });
  // The list of objects: a row shows its object and the look that brought it.
  function pick(row) {
    const article = find(episode.article), same = `[data-object="${row.dataset.object}"]`;
    for (const each of article.querySelectorAll(".picked")) each.classList.remove("picked");
    for (const each of article.querySelectorAll(same)) each.classList.add("picked");
    control.go(Number(row.dataset.look));
  }
  document.addEventListener("click", (event) => {
    const row = event.target.closest("tr[data-object]");
    if (row) return pick(row);
    const chosen = event.target.closest(".window");
    if (chosen) control.go(Number(chosen.dataset.look));
  });
  open(0);
  follow();
})();
