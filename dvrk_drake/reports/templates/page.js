"use strict";
// Draws the plots, and links the time cursor of the plots with the animations of Meshcat.
(async function () {
  // Width of the text of a printed A4 page with margins of 14 mm, and height of a plot with its caption [px].
  const PRINT_WIDTH = 680, PRINT_HEIGHT = 920;
  const CONFIG = { responsive: true, displaylogo: false, modeBarButtonsToRemove: ["lasso2d", "select2d"] };

  // Returns the text of an element whose content is Base64 of gzip.
  async function unpack(element) {
    const bytes = Uint8Array.from(atob(element.textContent), (c) => c.charCodeAt(0));
    return new Response(new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"))).text();
  }

  const plotly = document.getElementById("plotly");
  const script = document.createElement("script");
  script.textContent = await unpack(plotly);
  plotly.replaceWith(script);
  const plots = [], figures = new Map();
  const dark = matchMedia("(prefers-color-scheme: dark)");
  const darkColours = JSON.parse(document.getElementById("dark").textContent);

  // Returns a figure from JSON, on a dark page with the colours that are visible there.
  function coloured(text) {
    if (dark.matches) for (const [from, to] of Object.entries(darkColours)) text = text.replaceAll(from, to);
    return JSON.parse(text);
  }

  dark.addEventListener("change", () => plots.forEach((plot) => {
    const figure = coloured(figures.get(plot));
    Plotly.react(plot, figure.data, figure.layout, CONFIG);
  }));
  for (const packed of document.querySelectorAll("script[data-plot]")) {
    const text = await unpack(packed);
    const figure = coloured(text);
    const element = document.getElementById(packed.dataset.plot);
    figures.set(element, text);
    // When the window is resized, Plotly forgets the height of the layout and uses that of the element.
    element.style.height = `${figure.layout.height}px`;
    await Plotly.newPlot(element, figure.data, figure.layout, CONFIG);
    plots.push(element);
  }
  const timePlots = plots.filter((plot) => "time" in plot.dataset);
  const views = [...document.querySelectorAll("figure.meshcat")].map((figure) => ({
    figure,
    start: Number(figure.dataset.start),
    poses: Number(figure.dataset.poses),
    frame: figure.querySelector("iframe"),
    player: figure.querySelector(".player"),
    button: figure.querySelector(".play"),
    slider: figure.querySelector(".seek"),
    output: figure.querySelector(".time"),
    animator: null,
    shown: -1,
  }));
  for (const view of views) view.frame.srcdoc = await unpack(view.figure.querySelector(".scene"));
  let time = null; // of the cursor [s]; null while there is no animation

  const viewerOf = (view) => view.frame.contentWindow && view.frame.contentWindow.viewer;
  const xAxes = (plot) => Object.keys(plot._fullLayout).filter((key) => /^xaxis\d*$/.test(key)).map((key) => plot._fullLayout[key]);
  const toPixel = (axis, t) => axis._offset + axis.l2p(t);

  function placeCursors(plot) {
    if (time === null || !plot._fullLayout) return;
    const size = plot._fullLayout._size;
    const axes = xAxes(plot);
    plot.cursors = plot.cursors || [];
    while (plot.cursors.length < axes.length) plot.cursors.push(addCursor(plot, plot.cursors.length));
    axes.forEach((axis, i) => {
      // Each panel has its own line, so that no line crosses a title.
      const x = toPixel(axis, time), y = axis._mainSubplot ? plot._fullLayout._plots[axis._mainSubplot].yaxis : null;
      const inside = x >= axis._offset - 1 && x <= axis._offset + axis._length + 1;
      Object.assign(plot.cursors[i].style, {
        display: inside ? "block" : "none", left: x + "px",
        top: (y ? y._offset : size.t) + "px", height: (y ? y._length : size.h) + "px",
      });
    });
  }

  function addCursor(plot, index) {
    const cursor = document.createElement("div");
    cursor.className = "cursor";
    cursor.title = "Drag to move the animation";
    cursor.addEventListener("pointerdown", (event) => {
      cursor.setPointerCapture(event.pointerId);
      event.preventDefault();
      event.stopPropagation();
    });
    cursor.addEventListener("pointermove", (event) => {
      if (cursor.hasPointerCapture(event.pointerId)) seek(timeAt(plot, xAxes(plot)[index], event));
    });
    plot.appendChild(cursor);
    return cursor;
  }

  function timeAt(plot, axis, event) {
    return axis.p2l(event.clientX - plot.getBoundingClientRect().left - axis._offset);
  }

  function onClick(plot, event, down) {
    if (Math.hypot(event.clientX - down.clientX, event.clientY - down.clientY) > 3) return;
    const box = plot.getBoundingClientRect();
    const x = event.clientX - box.left, y = event.clientY - box.top, size = plot._fullLayout._size;
    const axis = xAxes(plot).find((a) => x >= a._offset && x <= a._offset + a._length);
    if (axis && y >= size.t && y <= size.t + size.h) seek(timeAt(plot, axis, event));
  }

  timePlots.forEach((plot) => {
    plot.on("plotly_afterplot", () => placeCursors(plot));
    let down = null;
    plot.addEventListener("pointerdown", (event) => { down = event.target.closest(".cursor") ? null : event; }, true);
    document.addEventListener("pointerup", (event) => {
      if (down && time !== null) onClick(plot, event, down);
      down = null;
    }, true);
  });

  function seek(t) {
    for (const view of views) if (view.animator) seekView(view, t);
    setTime(t);
  }

  function seekView(view, t) {
    const animator = view.animator;
    animator.pause();
    // Actions at their end are paused, and only active actions move the bodies.
    for (const action of animator.actions) { action.paused = false; action.play(); }
    const local = Math.min(Math.max(t - view.start, 0), animator.duration - 1e-6);
    animator.seek(local);
    animator.display_progress(local);
    view.shown = local;
  }

  function setTime(t) {
    const view = views.find((v) => v.animator);
    time = Math.min(Math.max(t, view.start), view.start + view.animator.duration);
    timePlots.forEach(placeCursors);
    for (const v of views) if (v.animator) {
      v.slider.value = time - v.start;
      v.output.textContent = v.poses ? `pose ${Math.round(time)} of ${v.poses}` : `${time.toFixed(2)} s`;
      v.button.textContent = v.animator.playing ? "Pause" : "Play";
    }
  }

  function connect(view) {
    const viewer = viewerOf(view);
    if (!viewer || !viewer.animator || viewer.animator.actions.length === 0) return;
    view.animator = viewer.animator;
    view.player.hidden = false;
    view.slider.max = view.animator.duration;
    view.slider.addEventListener("input", () => seek(view.start + Number(view.slider.value)));
    view.button.addEventListener("click", () => {
      if (view.animator.playing) view.animator.pause();
      else view.animator.play();
      setTime(view.start + view.animator.time);
    });
    seekView(view, view.start);
    if (time === null) setTime(view.start);
  }

  // Follows animations that play, also if they are started with the controls of Meshcat.
  function follow() {
    for (const view of views) {
      if (!view.animator) { connect(view); continue; }
      if (view.animator.time === view.shown) continue;
      view.shown = view.animator.time;
      const t = view.start + view.shown;
      for (const other of views) if (other !== view && other.animator && !other.animator.playing) seekView(other, t);
      setTime(t);
    }
    requestAnimationFrame(follow);
  }
  if (views.length) requestAnimationFrame(follow);

  document.querySelectorAll("button.copy").forEach((button) => button.addEventListener("click", async () => {
    const code = button.parentElement.querySelector("code");
    try {
      await navigator.clipboard.writeText(code.textContent);
    } catch {
      getSelection().selectAllChildren(code);
      document.execCommand("copy");
    }
    button.textContent = "Copied";
    setTimeout(() => { button.textContent = "Copy"; }, 1500);
  }));

  // Plots in a folded section have no width until it is opened.
  document.querySelectorAll("details").forEach((details) => details.addEventListener("toggle", () => {
    details.querySelectorAll(".js-plotly-plot").forEach((plot) => Plotly.Plots.resize(plot));
  }));

  // Plots have a width in pixels, and a frame may print empty.
  window.addEventListener("beforeprint", () => {
    document.querySelectorAll("details").forEach((details) => { details.open = true; });
    for (const plot of plots) {
      plot.screenHeight = parseFloat(plot.style.height);
      const height = Math.min(plot.screenHeight, PRINT_HEIGHT);
      plot.style.height = `${height}px`;
      Plotly.relayout(plot, { width: PRINT_WIDTH, height });
    }
    for (const view of views) {
      const viewer = viewerOf(view), printed = view.figure.querySelector(".printed");
      if (!viewer) continue;
      viewer.render();
      const picture = viewer.renderer.domElement;
      printed.width = picture.width;
      printed.height = picture.height;
      printed.getContext("2d").drawImage(picture, 0, 0);
    }
  });
  window.addEventListener("afterprint", () => {
    for (const plot of plots) {
      plot.style.height = `${plot.screenHeight}px`;
      Plotly.relayout(plot, { width: null, height: null, autosize: true });
    }
  });
  document.documentElement.dataset.ready = "yes";
})();
