// Plays a recorded game.

import { Board } from "./board.js";

const stage = document.getElementById("replay");
let board, timer;

async function play(address) {
  clearInterval(timer);
  const answer = await fetch(address);
  if (!answer.ok) {
    stage.querySelector(".note").textContent = "This game cannot be shown.";
    return;
  }
  const film = await answer.json();
  stage.hidden = false;
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
}
