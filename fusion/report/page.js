"use strict";
(() => {
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

  function draw() {
    const style = getComputedStyle(document.documentElement);
    for (const key of keys) {
      Plotly.react(key, paint(figures[key].data, style), paint(figures[key].layout, style), config);
    }
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

  draw();
  for (const key of timed) {
    document.getElementById(key).on("plotly_relayout", (change) => follow(key, change));
  }
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", draw);
  addEventListener("beforeprint", () => { document.documentElement.dataset.print = ""; draw(); });
  addEventListener("afterprint", () => { delete document.documentElement.dataset.print; draw(); });
})();
