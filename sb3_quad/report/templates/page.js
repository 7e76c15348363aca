"use strict";
(() => {
  const figures = JSON.parse(document.getElementById("figures").textContent);
  const buttons = {
    plane: [["toImage"], ["zoom2d", "pan2d", "resetScale2d"]],
    space: [["toImage"], ["orbitRotation", "pan3d", "zoom3d", "resetCameraDefault3d"]],
  };
  const settings = (kind) => ({
    responsive: true, displaylogo: false, displayModeBar: "hover", scrollZoom: false, modeBarButtons: buttons[kind],
  });
  const dark = window.matchMedia("(prefers-color-scheme: dark)");

  // Colours of text, grid and paper are the page's; the figures' own say nothing about them.
  function themed(layout) {
    const [ink, grid, paper] = ["--ink", "--grid", "--paper"].map(variable);
    const axis = { gridcolor: grid, linecolor: grid, tickcolor: grid };
    const result = {
      ...layout, paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)",
      font: { family: getComputedStyle(document.body).fontFamily, size: 13, color: ink },
      hoverlabel: { bgcolor: paper, bordercolor: grid, font: { color: ink } },
      modebar: { bgcolor: "rgba(0,0,0,0)", color: grid, activecolor: ink },
    };
    for (const name of Object.keys(layout)) {
      if (/^[xy]axis\d*$/.test(name)) result[name] = { ...layout[name], ...axis };
    }
    if (layout.scene) {
      result.scene = { ...layout.scene, bgcolor: "rgba(0,0,0,0)" };
      const strong = { ...axis, gridcolor: variable("--grid3d"), linecolor: variable("--grid3d") };
      for (const name of ["xaxis", "yaxis", "zaxis"]) result.scene[name] = { ...layout.scene[name], ...strong };
    }
    return result;
  }

  const variable = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
  const coloured = (data) => JSON.parse(JSON.stringify(data).replace(/"@(ink|paper)"/g, (_, name) => `"${variable("--" + name)}"`));

  function show(plot) {
    const figure = figures[plot.dataset.figure];
    plot.dataset.drawn = "yes";
    Plotly.newPlot(plot, coloured(figure.data), themed(figure.layout), settings(plot.dataset.kind));
  }

  // Browsers keep few 3-D drawings at once: those out of sight are put away, with the view that was chosen.
  function putAway(plot) {
    if (plot._fullLayout && plot._fullLayout.scene) {
      figures[plot.dataset.figure].layout.scene.camera = plot._fullLayout.scene.camera;
    }
    Plotly.purge(plot);
    delete plot.dataset.drawn;
  }

  const watcher = new IntersectionObserver((entries) => {
    for (const entry of entries) {
      const plot = entry.target;
      if (entry.isIntersecting && !plot.dataset.drawn) show(plot);
      if (!entry.isIntersecting && plot.dataset.drawn && plot.dataset.kind === "space") putAway(plot);
    }
  }, { rootMargin: "600px 0px" });

  const plots = document.querySelectorAll(".plot");
  plots.forEach((plot) => watcher.observe(plot));
  dark.addEventListener("change", () => plots.forEach((plot) => {
    if (plot.dataset.drawn) { putAway(plot); show(plot); }
  }));
  window.addEventListener("beforeprint", () => plots.forEach((plot) => { if (!plot.dataset.drawn) show(plot); }));
  document.documentElement.dataset.ready = "yes";
})();
