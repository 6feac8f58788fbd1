// Shows the words of the game that is chosen.
const form = document.getElementById("free");

function choose() {
  for (const part of form.querySelectorAll(".of-game")) {
    const chosen = part.dataset.game === form.environment.value;
    part.hidden = !chosen;
    part.querySelector("select").disabled = !chosen;
  }
}

form.environment.addEventListener("change", choose);
choose();
