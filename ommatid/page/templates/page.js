"use strict";
// Draws the figures and connects them to the page: colours, buttons, print, and values by row and column.
(async () => {
  const { document: content, roots } = JSON.parse(document.getElementById("figures").textContent);
  const [views] = await Bokeh.embed.embed_items({ page: content }, [{ docid: "page", roots, root_ids: Object.keys(roots) }]);
  const bokehDocument = Bokeh.documents[Bokeh.documents.length - 1];
  const figures = bokehDocument.roots();
  const dark = matchMedia("(prefers-color-scheme: dark)");
  const print = matchMedia("print");
  const touch = matchMedia("(pointer: coarse)");

  // Errors are the difference of two other maps, so the page does not contain them.
  const maps = bokehDocument.get_model_by_name("maps");
  if (maps && maps.data.error) {
    const { truth, estimate, error } = maps.data;
    error[0].forEach((_, index) => { error[0][index] = estimate[0][index] - truth[0][index]; });
    maps.change.emit();
  }

  function setColours(printed) {
    const look = dark.matches && !printed ? "dark" : "light";
    const style = getComputedStyle(document.documentElement);
    const [ink, soft, line, paper] = ["ink", "soft", "line", "paper"].map(
      (name) => style.getPropertyValue(`--${name}-${look}`).trim(),
    );
    for (const figure of figures) {
      figure.outline_line_color = line;
      for (const part of [...figure.left, ...figure.right, ...figure.above, ...figure.below, ...figure.center]) {
        if (part.type.endsWith("Axis")) {
          part.setv({
            axis_label_text_color: soft, major_label_text_color: soft, axis_line_color: line,
            major_tick_line_color: line,
          });
        } else if (part.type === "ColorBar") {
          part.setv({ title_text_color: soft, major_label_text_color: soft, bar_line_color: line, major_tick_line_color: soft });
        } else if (part.type === "Grid") {
          part.grid_line_color = line;
        } else if (part.type === "Legend") {
          part.setv({ label_text_color: ink, background_fill_color: paper, border_line_color: line });
        }
      }
    }
    if (!printed) document.documentElement.dataset.look = look;
  }
  setColours(false);
  dark.addEventListener("change", () => setColours(false));

  // Browsers print without waiting for canvases to be redrawn, so images of the figures in light colours are prepared.
  const shown = [...views.roots].filter((view) => figures.includes(view.model));
  let drawing = false;
  let timer = 0;
  function drawPrintImages() {
    drawing = true;
    const recolour = document.documentElement.dataset.look === "dark";
    if (recolour) setColours(true);
    for (const view of shown) {
      const { width, height } = view.el.getBoundingClientRect();
      if (width === 0 || height === 0) continue;
      if (recolour) view.repaint();
      document.getElementById(`print-${view.model.name}`).src = view.export("png").canvas.toDataURL();
    }
    if (recolour) {
      setColours(false);
      for (const view of shown) view.repaint();
    }
    drawing = false;
    document.documentElement.dataset.printable = "yes";
  }
  function schedulePrintImages() {
    if (drawing || print.matches) return;
    delete document.documentElement.dataset.printable;
    clearTimeout(timer);
    timer = setTimeout(drawPrintImages, 500);
  }
  bokehDocument.on_change(schedulePrintImages);
  addEventListener("resize", schedulePrintImages);
  schedulePrintImages();

  // On touch screens a finger scrolls the page over an unzoomed map, and moves a zoomed one.
  const initial = new Map(figures.map((figure) => [figure, [figure.x_range, figure.y_range].map((range) => [range.start, range.end])]));
  const reset = (figure) => [figure.x_range, figure.y_range].forEach((range, axis) => {
    [range.start, range.end] = initial.get(figure)[axis];
  });
  const isWhole = (figure) => {
    const [start, end] = initial.get(figure)[0];
    return Math.abs(figure.x_range.end - figure.x_range.start) >= 0.999 * Math.abs(end - start);
  };
  function setGestures() {
    for (const figure of figures) {
      for (const tool of figure.toolbar.tools) {
        if (tool.type === "PanTool") tool.active = !touch.matches || !isWhole(figure);
        if (tool.type === "WheelZoomTool") tool.active = !touch.matches;
      }
    }
  }
  setGestures();
  touch.addEventListener("change", setGestures);

  function zoom(figure, factor) {
    for (const range of [figure.x_range, figure.y_range]) {
      const middle = (range.start + range.end) / 2;
      const half = (range.end - range.start) / 2 / factor;
      range.setv({ start: middle - half, end: middle + half });
    }
    if (isWhole(figure)) reset(figure);
  }
  for (const bar of document.querySelectorAll(".tools")) {
    bar.addEventListener("click", (event) => {
      const button = event.target.closest("button");
      if (!button) return;
      const figure = figures.find((candidate) => `plot-${candidate.name}` === bar.dataset.plot);
      const factor = Number(button.dataset.zoom);
      if (factor === 0) reset(figure); else zoom(figure, factor);
      setGestures();
    });
  }

  const pixel = document.getElementById("pixel");
  if (pixel) {
    const labels = { deviation: "standard deviation" };
    const names = Object.keys(maps.data);
    const showValues = () => {
      const { row, column } = pixel.elements;
      const block = Number(pixel.dataset.block);
      const [rows, columns] = maps.data[names[0]][0].shape;
      const [i, j] = [row, column].map((field) => Math.floor(Number(field.value) / block));
      const valid = row.value !== "" && column.value !== "" && row.validity.valid && column.validity.valid;
      pixel.querySelector("output").textContent = valid && i < rows && j < columns
        ? names.map((name) => `${labels[name] ?? name} ${maps.data[name][0][i * columns + j].toPrecision(5)}`).join(", ")
        : "outside the image";
    };
    pixel.addEventListener("input", showValues);
    pixel.addEventListener("submit", (event) => event.preventDefault());
    showValues();
  }

  const lens = document.getElementById("lens");
  lens?.addEventListener("change", () => {
    for (const response of document.querySelectorAll(".response")) response.hidden = response.dataset.lens !== lens.value;
    schedulePrintImages();
  });
})();
