// A form that is sent once: making an agent takes a moment.
for (const form of document.querySelectorAll("form.once")) {
  form.addEventListener("submit", () => {
    const button = form.querySelector("button");
    button.disabled = true;
    button.textContent = "Making your agent…";
  });
}
