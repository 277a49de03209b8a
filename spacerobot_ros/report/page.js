// The page's own controls: light or dark, and hints where something is wider than the screen.
"use strict";
(() => {
  const root = document.documentElement;
  const button = document.getElementById("theme");
  const wanted = matchMedia("(prefers-color-scheme: dark)");
  const dark = () => getComputedStyle(root).getPropertyValue("--dark").trim() === "1";

  function changed() {
    button.textContent = dark() ? "Light" : "Dark";
    document.dispatchEvent(new CustomEvent("flight:theme", { detail: dark() }));
  }
  button.hidden = false;
  button.onclick = () => {
    root.dataset.theme = dark() ? "light" : "dark";
    changed();
  };
  wanted.addEventListener("change", changed);

  function hint() {
    for (const box of document.querySelectorAll(".scroll")) {
      const shown = box.clientWidth > 0 && box.scrollWidth > box.clientWidth + 2;
      if (box.previousElementSibling) box.previousElementSibling.classList.toggle("needed", shown);
    }
  }
  addEventListener("resize", hint);
  hint();
  changed();
})();
