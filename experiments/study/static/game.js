// Plays a round: sends the buttons that go down and up, shows what the server says.

import { Board } from "./board.js";

const KEYS = {
  ArrowUp: "up", ArrowDown: "down", ArrowLeft: "left", ArrowRight: "right", " ": "act",
  w: "up", s: "down", a: "left", d: "right",
};
// Why the server closed the connection (experiments/study/play.py).
const POLICY_VIOLATION = 1008, TAKEN_OVER = 4001, GONE = 4004;
const stage = document.getElementById("game");
const note = stage.querySelector(".note");
let board, socket, over = false, attempts = 0, echoed = 0;

function say(text) {
  note.textContent = text;
}

function send(message) {
  if (socket?.readyState === WebSocket.OPEN) socket.send(JSON.stringify(message));
}

function goOn() {
  over = true;
  window.location.assign(stage.dataset.after);
}

function connect() {
  const scheme = window.location.protocol === "https:" ? "wss" : "ws";
  board = new Board(stage); // the server sends a new connection everything
  socket = new WebSocket(`${scheme}://${window.location.host}${stage.dataset.socket}`);
  socket.onopen = () => {
    attempts = 0;
    say("");
  };
  socket.onmessage = (event) => {
    const message = JSON.parse(event.data);
    board.show(message);
    if (performance.now() - echoed > 1000) {
      echoed = performance.now();
      send({ echo: message.sent });
    }
    if (message.over) {
      over = true;
      say("The round is over.");
      setTimeout(goOn, 1500);
    }
  };
  socket.onclose = (event) => {
    if (over) return;
    if (event.code === GONE) return goOn();
    if (event.code === TAKEN_OVER) return say("The game goes on in another window.");
    if (event.code === POLICY_VIOLATION) return say("The server refused this connection.");
    say("The connection is lost; trying again…");
    attempts += 1;
    setTimeout(connect, Math.min(5000, 250 * 2 ** attempts));
  };
}

function press(button, down) {
  send({ button, down });
}

window.addEventListener("keydown", (event) => {
  const button = KEYS[event.key];
  if (!button || event.ctrlKey || event.metaKey || event.altKey) return;
  event.preventDefault();
  if (!event.repeat) press(button, true);
});
window.addEventListener("keyup", (event) => {
  if (KEYS[event.key]) press(KEYS[event.key], false);
});
window.addEventListener("blur", () => send({ away: true }));
document.addEventListener("visibilitychange", () => {
  if (document.hidden) send({ away: true });
});
for (const button of document.querySelectorAll("[data-button]")) {
  const name = button.dataset.button;
  button.addEventListener("pointerdown", (event) => {
    event.preventDefault();
    button.setPointerCapture(event.pointerId);
    press(name, true);
  });
  for (const end of ["pointerup", "pointercancel"]) button.addEventListener(end, () => press(name, false));
  button.addEventListener("contextmenu", (event) => event.preventDefault());
}
connect();
