// Runs in the page before viser's own script: what viser has no options for.
// Where another version of viser lacks these objects, the scene looks as without this script.
"use strict";

(() => {
  // Colours of texts: readable on light and dark pages. The page names them, with those of old
  // pages in case this script is not there.
  const COLORS = `
    :root {
      --ok-color: #1a7441; --warn-color: #855800; --bad-color: #b3261e; --faint-color: #5c626b;
      --mantine-color-dimmed: #5c626b !important;
    }
    :root[data-mantine-color-scheme="dark"] {
      --ok-color: #4cc38a; --warn-color: #e5a93d; --bad-color: #ff8a80; --faint-color: #a4a9b2;
      --mantine-color-dimmed: #a4a9b2 !important;
    }
    :root[data-mantine-color-scheme="light"] {
      --mantine-color-blue-outline: #1461a8 !important;
      --mantine-color-gray-filled: #5c626b !important;
      --mantine-color-gray-filled-hover: #495057 !important;
    }
    .mantine-Slider-markLabel, .mantine-Notification-description {
      color: var(--mantine-color-dimmed) !important;
    }
    [role="tab"] span { color: var(--mantine-color-text) !important; }
    [role="tab"][aria-selected="true"] span { color: var(--mantine-color-blue-outline) !important; }
    /* Folders that are closed have no empty box, and the panel of a phone takes its whole width. */
    .mantine-Paper-root > [role="button"] ~ div:last-child div:empty { padding: 2px !important; }
    [style*="position: fixed"][style*="max-height: 60%"],
    [style*="position: fixed"][style*="max-height: 60%"] [style*="width: 20em"] {
      width: 100% !important;
    }
    /* The number beside a slider has room for six digits. */
    .mantine-NumberInput-root[style*="width: 3rem"] { width: 4.2rem !important; }
    :focus-visible { outline: 2px solid #4dabf7; outline-offset: 1px; }
  `;

  // -- the scene --------------------------------------------------------------------------------

  // Paths are seen through the robot, after everything else is drawn.
  const PATH = /^\/(planned|flown)_path/;
  const GHOST = "/goal/ghost";
  const PATH_ORDER = 10;

  function showInFront(node) {
    node.traverse((each) => {
      const material = each.material;
      if (!each.isLineSegments2 || !material.depthTest) return;
      each.renderOrder = PATH_ORDER;
      material.depthTest = false;
      material.transparent = true; // After the ghost, which is transparent too.
      material.needsUpdate = true;
    });
  }

  // Faces of the ghost that coincide with those of the robot lie behind them, and do not flicker.
  function setBack(node) {
    node.traverse((each) => {
      if (!each.isMesh || each.material.polygonOffset) return;
      each.material.polygonOffset = true;
      each.material.polygonOffsetFactor = 1;
      each.material.polygonOffsetUnits = 4;
      each.material.depthWrite = false;
    });
  }

  // A surface does not shade itself: its points are tested a little above it.
  function liftShadows(scene) {
    for (const light of scene.children) {
      if (!light.isDirectionalLight || !light.castShadow) continue;
      const { camera, mapSize } = light.shadow;
      light.shadow.normalBias = (1.5 * (camera.right - camera.left)) / mapSize.x;
    }
  }

  // Pages report their cameras late: if the viewer moved them, they would fall behind the robot.
  let followed = null;

  function follow(viewer) {
    const robot = viewer.nodeRefFromName["/robot"];
    const here = robot?.visible ? robot.getWorldPosition(robot.position.clone()) : null;
    if (here && followed && !here.equals(followed) && viewer.cameraControl) {
      const labels = [...document.querySelectorAll("label[for]")];
      const box = labels.find((label) => label.textContent.trim() === "Follow the robot");
      const { x, y, z } = viewer.cameraControl.getTarget(here.clone()).add(here).sub(followed);
      if (box?.control?.checked) viewer.cameraControl.moveTo(x, y, z, false);
    }
    followed = here;
  }

  function dress(nodes) {
    for (const [name, node] of Object.entries(nodes)) {
      if (!node) continue;
      if (PATH.test(name)) showInFront(node);
      else if (name === GHOST) setBack(node);
    }
  }

  // -- names and keys of controls, for screen readers and keyboards -----------------------------

  const AXES = ["x", "y", "z"];

  // A label names the first field of its row alone: sliders and vectors have more.
  function nameFields() {
    for (const label of document.querySelectorAll("label[for]")) {
      const row = label.closest(".mantine-Text-root")?.parentElement?.parentElement;
      if (!row) continue;
      const text = label.textContent.trim();
      const fields = [...row.querySelectorAll("input:not([type=hidden])")];
      fields.forEach((field, number) => {
        if (field.labels?.length) return;
        name(field, fields.length === 3 ? `${text} ${AXES[number]}` : `${text}, as a number`);
      });
      if (fields.length === 3) name(fields[0], `${text} x`);
      for (const slider of row.querySelectorAll("[role=slider]")) name(slider, text);
    }
  }

  function name(element, text) {
    if (element.getAttribute("aria-label") !== text) element.setAttribute("aria-label", text);
  }

  function nameButtons() {
    for (const button of document.querySelectorAll("button:not([aria-label])")) {
      if (button.textContent.trim() || button.title) continue;
      name(button, button.closest("[role=alert]") ? "Close this message" : "Connection and scene");
    }
    for (const bar of document.querySelectorAll("[role=progressbar]:not([aria-label])")) {
      name(bar, "Flown share of the manoeuvre");
    }
  }

  // Folders open by a click alone: they become buttons.
  function openByKey() {
    const titles = '.mantine-Paper-root > .mantine-Paper-root[style*="pointer"]:not([role])';
    for (const title of document.querySelectorAll(titles)) {
      title.setAttribute("role", "button");
      title.tabIndex = 0;
      title.addEventListener("keydown", (event) => {
        if (event.key !== "Enter" && event.key !== " ") return;
        event.preventDefault();
        title.click();
      });
    }
  }

  let waiting = false;

  function describe() {
    waiting = false;
    document.getElementById("root").setAttribute("role", "main");
    nameFields();
    nameButtons();
    openByKey();
  }

  document.addEventListener("DOMContentLoaded", () => {
    const style = document.createElement("style");
    style.textContent = COLORS;
    document.head.append(style);
    describe();
    new MutationObserver(() => {
      if (!waiting) setTimeout(describe, 100);
      waiting = true;
    }).observe(document.body, { childList: true, subtree: true });
  });

  // -- whether the viewer runs -------------------------------------------------------------------

  // A viewer that is killed cannot say so: the page asks for it, and is grey while none answers.
  const PERIOD_MS = 1500;
  let missed = 0;
  let notice = null;

  function showAlive(alive) {
    missed = alive ? 0 : missed + 1;
    document.documentElement.style.filter = missed > 1 ? "grayscale(1)" : "";
    if (missed > 1 && notice === null) {
      notice = document.createElement("div");
      notice.setAttribute("role", "alert");
      notice.textContent =
        "The viewer does not respond. This page shows its last state and can no longer steer the robot.";
      notice.style.cssText =
        "position:fixed;top:0;left:0;right:max(0px, min(26em, 100vw - 40em));z-index:10000;" +
        "padding:.6em 1em;text-align:center;" +
        "background:#222;color:#fff;font:600 15px sans-serif;border-bottom:2px solid #fff";
      document.body.append(notice);
    } else if (missed === 0 && notice !== null) {
      notice.remove();
      notice = null;
    }
  }

  let server = null;

  setInterval(() => {
    fetch("/alive", { cache: "no-store" }).then((answer) => answer.text()).then(
      (text) => {
        // viser's page connects again only while it has the focus.
        if (server !== null && text !== server) location.reload();
        server = text;
        showAlive(true);
      },
      () => showAlive(false),
    );
  }, PERIOD_MS);

  let dressed = null;
  setInterval(() => {
    const viewer = window.__viserMutable;
    if (!viewer || !viewer.scene || viewer.scene === dressed) return;
    dressed = viewer.scene;
    dressed.onBeforeRender = () => {
      dress(viewer.nodeRefFromName);
      liftShadows(viewer.scene);
      follow(viewer);
    };
  }, 200);
})();
