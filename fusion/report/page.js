"use strict";
(() => {
  performance.mark("script");
  const figures = JSON.parse(document.getElementById("figures").textContent);
  const config = {
    responsive: true, displaylogo: false, displayModeBar: innerWidth > 760 ? "hover" : false,
    showSendToCloud: false, plotlyServerURL: "", // nothing of a recording leaves this page
    modeBarButtonsToRemove: ["lasso2d", "select2d", "autoScale2d", "tableRotation", "resetCameraLastSave3d"],
  };
  const keys = Object.keys(figures).filter((key) => document.getElementById(key));
  const timed = keys.filter((key) => figures[key].layout.xaxis);

  // Figures name colours by style sheet variable; this puts in what the current scheme says.
  function paint(value, style) {
    if (typeof value === "string") return value.startsWith("--") ? style.getPropertyValue(value).trim() : value;
    if (Array.isArray(value)) return typeof value[0] === "object" && value[0] ? value.map((v) => paint(v, style)) : value;
    if (value && typeof value === "object") {
      return Object.fromEntries(Object.entries(value).map(([key, v]) => [key, paint(v, style)]));
    }
    return value;
  }

  const shown = new Set();
  function draw(key) {
    const style = getComputedStyle(document.documentElement);
    Plotly.react(key, paint(figures[key].data, style), paint(figures[key].layout, style), config);
    if (shown.has(key)) return;
    if (!shown.size) performance.mark("first-figure");
    shown.add(key);
    if (timed.includes(key)) document.getElementById(key).on("plotly_relayout", (change) => follow(key, change));
  }

  // One figure after the other, so that the page answers while it draws; those in space take longest and come last.
  async function drawAll() {
    for (const key of [...timed, ...keys.filter((key) => !timed.includes(key))]) {
      if (!shown.has(key)) draw(key);
      await new Promise((next) => setTimeout(next));
    }
    return Math.round(performance.now());
  }

  // Zooming into a span of time shows the same span everywhere.
  let following = false;
  function follow(source, change) {
    const reset = change["xaxis.autorange"];
    const range = change["xaxis.range"] || [change["xaxis.range[0]"], change["xaxis.range[1]"]];
    if (following || (!reset && range[0] === undefined)) return;
    following = true;
    const others = timed.filter((key) => key !== source);
    const same = (key) => ({ "xaxis.range": reset ? figures[key].layout.xaxis.range : range });
    Promise.all(others.map((key) => Plotly.relayout(key, same(key))))
      .finally(() => { following = false; });
  }

  // Keys: arrows move or turn, + and - zoom, Home goes back.
  const moves = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };
  const zooms = { "+": 0.8, "=": 0.8, "-": 1.25, "_": 1.25 };

  function alongTime(key, event) {
    const home = figures[key].layout.xaxis.range;
    const [low, high] = document.getElementById(key).layout.xaxis.range.map(Number);
    const step = moves[event.key], factor = zooms[event.key];
    if (event.key === "Home") return { "xaxis.range": [...home], "yaxis.autorange": true };
    if (step && step[0]) return { "xaxis.range": [low, high].map((v) => v + 0.1 * step[0] * (high - low)) };
    if (factor) return { "xaxis.range": [-0.5, 0.5].map((half) => (low + high) / 2 + half * factor * (high - low)) };
    return null;
  }

  function inSpace(key, event) {
    const home = figures[key].layout.scene.camera;
    const { eye, center } = document.getElementById(key).layout.scene.camera || home;
    const step = moves[event.key], factor = zooms[event.key];
    if (event.key === "Home") return { "scene.camera": JSON.parse(JSON.stringify(home)) };
    if (!step && !factor) return null;
    const [turn, lift] = step || [0, 0];
    const angle = Math.atan2(eye.y, eye.x) + 0.15 * turn, flat = Math.hypot(eye.x, eye.y);
    const rise = Math.max(-1.4, Math.min(1.4, Math.atan2(eye.z, flat) + 0.1 * lift));
    const far = Math.hypot(flat, eye.z) * (factor || 1);
    const to = { x: far * Math.cos(rise) * Math.cos(angle), y: far * Math.cos(rise) * Math.sin(angle), z: far * Math.sin(rise) };
    return { "scene.camera": { eye: to, center, up: { x: 0, y: 0, z: 1 } } };
  }

  for (const key of keys) {
    document.getElementById(key).addEventListener("keydown", (event) => {
      if (!shown.has(key) || event.ctrlKey || event.metaKey || event.altKey) return;
      const change = figures[key].layout.xaxis ? alongTime(key, event) : inSpace(key, event);
      if (!change) return;
      event.preventDefault();
      Plotly.relayout(key, change);
    });
  }

  // Paper is narrower than most windows, and always light.
  const PAPER_PX = 680;
  function forPaper() {
    document.documentElement.dataset.print = "";
    for (const key of keys) {
      draw(key);
      if (figures[key].layout.xaxis) Plotly.relayout(key, { width: PAPER_PX, autosize: false });
    }
  }

  function forScreen() {
    delete document.documentElement.dataset.print;
    for (const key of keys) {
      draw(key);
      Plotly.relayout(key, { width: null, autosize: true });
    }
  }

  window.reportDrawn = drawAll();
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => [...shown].forEach(draw));
  addEventListener("beforeprint", forPaper);
  addEventListener("afterprint", forScreen);
})();
