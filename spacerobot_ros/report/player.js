// Plays a flight in MeshCat's viewer: time slider, play and pause, span of time, speed.
// The page holds the scene as MeshCat's commands in #flight.
"use strict";
(() => {
  const box = document.getElementById("animation");
  const [pane, play, slider, now, part, speed] =
    ["pane", "play", "time", "now", "part", "speed"].map((id) => document.getElementById(id));
  const scene = JSON.parse(document.getElementById("flight").textContent);

  let viewer;
  try {
    viewer = new MeshCat.Viewer(pane);
  } catch (error) {
    box.className = "without";
    return;
  }
  // MeshCat takes the height of the window; here the viewer is a part of the page.
  const resize = viewer.set_3d_pane_size.bind(viewer);
  viewer.set_3d_pane_size = () => resize(pane.clientWidth, pane.clientHeight);
  new ResizeObserver(() => viewer.set_3d_pane_size()).observe(pane);
  scene.commands.forEach((command) => viewer.handle_command(command));
  viewer.animator.pause();

  // The wheel scrolls the page until the picture has been clicked.
  viewer.controls.enableZoom = false;
  pane.addEventListener("pointerdown", () => { viewer.controls.enableZoom = true; });
  pane.addEventListener("pointerleave", () => { viewer.controls.enableZoom = false; });

  let span = scene.parts[0];
  let time = 0;
  let playing = false;
  let before = 0;

  const seconds = (value) => `${value.toFixed(span.end - span.start < 100 ? 2 : 0)} s`;

  function show(wanted) {
    time = Math.min(Math.max(wanted, span.start), span.end);
    viewer.animator.seek(time);
    slider.value = (time - span.start) / (span.end - span.start || 1);
    now.textContent = `${seconds(time)} of ${seconds(span.end)}`;
    document.dispatchEvent(new CustomEvent("flight:time", { detail: time }));
  }

  function setPlaying(wanted) {
    if (wanted && time >= span.end) show(span.start);
    playing = wanted;
    play.textContent = playing ? "Pause" : "Play";
    before = performance.now();
    if (playing) requestAnimationFrame(step);
  }

  function step(at) {
    if (!playing) return;
    show(time + (Math.max(at - before, 0) / 1000) * Number(speed.value));
    before = at;
    if (time < span.end) requestAnimationFrame(step);
    else setPlaying(false);
  }

  function choose(index) {
    span = scene.parts[index];
    const length = span.end - span.start;
    // Real time where that is short enough, else as fast as the whole takes twenty seconds.
    const fit = Math.max(1, Math.round(length / 20));
    const factors = [...new Set([0.25, 1, 10, 100, fit])].sort((a, b) => a - b);
    speed.replaceChildren(...factors.filter((f) => f <= 4 * fit).map((factor) => {
      const option = new Option(`${factor} × real time`, factor);
      option.selected = factor === fit;
      return option;
    }));
    show(span.start);
  }

  part.replaceChildren(...scene.parts.map(({ name }, index) => new Option(name, index)));
  part.hidden = scene.parts.length < 2;
  part.onchange = () => choose(Number(part.value));
  slider.oninput = () => {
    setPlaying(false);
    show(span.start + Number(slider.value) * (span.end - span.start));
  };
  play.onclick = () => setPlaying(!playing);
  document.addEventListener("flight:seek", ({ detail }) => {
    setPlaying(false);
    if (detail < span.start || detail > span.end) {
      part.value = 0;
      choose(0);
    }
    show(detail);
  });
  document.addEventListener("flight:theme", ({ detail: dark }) => {
    const value = dark ? [22 / 255, 25 / 255, 31 / 255] : [246 / 255, 247 / 255, 249 / 255];
    for (const property of ["top_color", "bottom_color"]) {
      viewer.handle_command({ type: "set_property", path: "/Background", property, value });
    }
  });
  choose(0);
  box.className = "ready";
  window.flightViewer = viewer;
})();
