// Plays a recorded game.

import { Board } from "./board.js";

const stage = document.getElementById("replay");
const note = stage.querySelector(".note");
let board, timer;

async function play(address) {
  clearInterval(timer);
  stage.hidden = false;
  note.textContent = "One moment …";
  const film = await fetch(address).then((answer) => (answer.ok ? answer.json() : null), () => null);
  note.textContent = film ? "" : "This game cannot be shown.";
  if (!film) return;
  board ??= new Board(stage);
  let next = 0;
  const step = () => {
    if (next >= film.frames.length) return clearInterval(timer);
    board.show({ ...film.frames[next], pictures: next === 0 ? film.pictures : {} });
    next += 1;
  };
  step();
  timer = setInterval(step, 1000 / film.hertz);
}

if (stage.dataset.film) play(stage.dataset.film);
for (const button of document.querySelectorAll(".replay-button")) {
  button.addEventListener("click", () => play(button.dataset.film));
  button.disabled = false; // The page has it disabled, so that no click comes before this line.
}
