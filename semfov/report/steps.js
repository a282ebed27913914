"use strict";
// The controls of a page of steps: a slider, buttons, keys, and playing. `last` gives the place of the last step, from
// 0, `show` draws the step that `steps.at` tells, `word` names one, and `first` is the number that a reader sees of the
// first one, where 0 is the step that shows all.
const find = (id) => document.getElementById(id);
document.documentElement.classList.add("scripted");

function stepper({ last, show, word, pause, first = 1 }) {
  const steps = { at: 0, stepped: false, draw, go, start, stop };
  let playing = null;
  function draw() {
    // There is nothing to step through where there was one look.
    document.querySelector(".controls").hidden = last() === 0;
    find("fixation").max = last();
    find("fixation").value = steps.at;
    // Before the first step all are shown.
    const place = steps.at + first;
    const number = place > 0 ? `${place} of ${last() + first}` : "all";
    const name = word()[0].toUpperCase() + word().slice(1);
    find("fixation").setAttribute("aria-valuetext", `${word()} ${number}`);
    find("word").textContent = place > 0 ? name : `${name}s:`;
    find("number").textContent = number;
    find("back").disabled = steps.at === 0;
    find("forward").disabled = steps.at === last();
    show();
  }
  function move(number) {
    const wanted = Math.min(Math.max(number, 0), last());
    if (wanted === steps.at && steps.stepped) return;
    Object.assign(steps, { at: wanted, stepped: true });
    draw();
  }
  function go(number) {
    stop();
    move(number);
  }
  // The page opens with the result: nothing is yet to come before the reader steps.
  function start(number = 0) {
    Object.assign(steps, { at: Math.min(number, last()), stepped: false });
    draw();
  }
  function stop() {
    clearInterval(playing);
    playing = null;
    find("play").textContent = "Play";
  }
  function play() {
    if (playing !== null) return stop();
    if (steps.at === last()) move(0);
    find("play").textContent = "Pause";
    playing = setInterval(() => {
      move(steps.at + 1);
      if (steps.at === last()) stop();
    }, pause);
  }
  find("fixation").addEventListener("input", (event) => go(Number(event.target.value)));
  find("back").addEventListener("click", () => go(steps.at - 1));
  find("forward").addEventListener("click", () => go(steps.at + 1));
  find("play").addEventListener("click", play);
  document.addEventListener("keydown", (event) => {
    // Lists and the slider use these keys themselves.
    if (event.target.closest("select, input, .wide") || event.altKey || event.ctrlKey || event.metaKey) return;
    const moves = { ArrowLeft: steps.at - 1, ArrowRight: steps.at + 1, Home: 0, End: last() };
    if (!(event.key in moves)) return;
    event.preventDefault();
    go(moves[event.key]);
  });
  return steps;
}
