"use strict";
(async () => {
  const spaces = JSON.parse(document.getElementById("spaces").textContent);
  const plots = document.querySelectorAll(".space");
  try {
    const packed = Uint8Array.from(atob(document.getElementById("plotly").textContent), (letter) => letter.charCodeAt(0));
    const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("gzip"));
    const script = document.createElement("script");
    script.textContent = await new Response(stream).text();
    document.head.append(script);
  } catch (error) {
    plots.forEach((plot) => { plot.textContent = `Flights in space need a newer browser (${error.message}).`; });
    return;
  }
  const settings = {
    responsive: true, displaylogo: false, displayModeBar: "hover", scrollZoom: false,
    modeBarButtons: [["toImage"], ["orbitRotation", "pan3d", "zoom3d", "resetCameraDefault3d"]],
  };
  const variable = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();

  // The colours of text and grid are the page's; the plots' own say nothing about them.
  function themed(layout) {
    const [ink, grid, paper, nothing] = [variable("--ink"), variable("--grid3d"), variable("--paper"), "rgba(0,0,0,0)"];
    const scene = { ...layout.scene, bgcolor: nothing };
    for (const name of ["xaxis", "yaxis", "zaxis"]) {
      scene[name] = { ...layout.scene[name], gridcolor: grid, linecolor: grid, tickcolor: grid };
    }
    return {
      ...layout, scene, paper_bgcolor: nothing,
      font: { family: getComputedStyle(document.body).fontFamily, size: 13, color: ink },
      hoverlabel: { bgcolor: paper, bordercolor: grid, font: { color: ink } },
      modebar: { bgcolor: nothing, color: grid, activecolor: ink },
    };
  }

  function show(plot) {
    if (plot.dataset.drawn) return;
    const { data, layout } = spaces[plot.dataset.plot];
    plot.dataset.drawn = "yes";
    Plotly.newPlot(plot, data, themed(layout), settings);
  }

  // Browsers keep few 3-D drawings at once: those out of sight are put away, with the view that was chosen.
  function putAway(plot) {
    if (!plot.dataset.drawn) return;
    if (plot._fullLayout) spaces[plot.dataset.plot].layout.scene.camera = plot._fullLayout.scene.camera;
    Plotly.purge(plot);
    delete plot.dataset.drawn;
  }

  const watcher = new IntersectionObserver((entries) => {
    for (const entry of entries) (entry.isIntersecting ? show : putAway)(entry.target);
  }, { rootMargin: "600px 0px" });

  plots.forEach((plot) => watcher.observe(plot));
  window.matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => plots.forEach((plot) => {
    if (plot.dataset.drawn) { putAway(plot); show(plot); }
  }));
  window.addEventListener("beforeprint", () => plots.forEach(show));
})();
