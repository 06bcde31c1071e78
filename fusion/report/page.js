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

  // The view in space from as far away as it takes to see all axes with their labels, however narrow the page.
  const FIELD = Math.tan(Math.PI / 8), NARROW_PX = 500, LEGEND_PX = 70; // Plotly's vertical field of view, halved
  function lookAtAll(key) {
    const { data, layout } = figures[key];
    const wide = document.getElementById(key).clientWidth;
    const narrow = wide < NARROW_PX, labels = narrow ? 64 : 50, text = { size: narrow ? 11 : 13 };
    layout.height = narrow ? 430 : 600;
    const sizes = ["x", "y", "z"].map((axis) => {
      Object.assign(layout.scene[`${axis}axis`], { nticks: narrow ? 4 : 0, tickfont: text });
      layout.scene[`${axis}axis`].title.font = text;
      let low = Infinity, high = -Infinity;
      for (const trace of data) for (const v of trace[axis]) if (v !== null) { low = Math.min(low, v); high = Math.max(high, v); }
      return high - low || 2;
    });
    const mean = Math.cbrt(sizes[0] * sizes[1] * sizes[2]); // of Plotly's box with equal scales
    const { eye, center } = layout.scene.camera;
    const length = Math.hypot(eye.x, eye.y, eye.z), flat = Math.hypot(eye.x, eye.y);
    const back = [eye.x / length, eye.y / length, eye.z / length], right = [-eye.y / flat, eye.x / flat, 0];
    const up = [-eye.z * eye.x / length / flat, -eye.z * eye.y / length / flat, flat / length];
    const along = (a, b) => Math.abs(a[0] * b[0] + a[1] * b[1] + a[2] * b[2]);
    const high = layout.height - LEGEND_PX;
    const reach = (pixels) => FIELD * pixels / high * Math.max(1 - 2 * labels / pixels, 0.3);
    const far = Math.max(...[0, 1, 2, 3, 4, 5, 6, 7].map((k) => {
      const corner = [center.x, center.y, center.z].map((middle, axis) => (k >> axis & 1 ? 0.5 : -0.5) * sizes[axis] / mean - middle);
      const toward = corner[0] * back[0] + corner[1] * back[1] + corner[2] * back[2];
      return toward + Math.max(along(corner, right) / reach(wide), along(corner, up) / reach(high));
    }));
    layout.scene.camera = { eye: { x: far * back[0], y: far * back[1], z: far * back[2] }, center, up: { x: 0, y: 0, z: 1 } };
  }

  const shown = new Set();
  function draw(key) {
    const style = getComputedStyle(document.documentElement);
    const layout = paint(figures[key].layout, style);
    const camera = shown.has(key) && document.getElementById(key).layout.scene?.camera;
    if (camera) layout.scene.camera = camera; // a change of colours does not turn the view
    Plotly.react(key, paint(figures[key].data, style), layout, config);
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

  keys.filter((key) => figures[key].layout.scene).forEach(lookAtAll);
  window.reportDrawn = drawAll();
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => [...shown].forEach(draw));
  addEventListener("beforeprint", forPaper);
  addEventListener("afterprint", forScreen);
})();
