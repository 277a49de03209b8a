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
      // Arrow keys scroll a box that has the focus.
      if (shown) box.tabIndex = 0;
      else box.removeAttribute("tabindex");
    }
  }
  // On paper everything is unfolded; afterwards each is as it was.
  const folds = () => [...document.querySelectorAll("details:not(#licences)")];
  let folded = [];
  addEventListener("beforeprint", () => {
    folded = folds().filter((each) => !each.open);
    folded.forEach((each) => { each.open = true; });
  });
  addEventListener("afterprint", () => folded.forEach((each) => { each.open = false; }));

  addEventListener("resize", hint);
  hint();
  changed();
})();
