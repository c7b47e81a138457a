"use strict";
// Puts the figures into the page and joins them to it: colours, buttons, and values without a pointer.
(async () => {
  const { document: content, roots } = JSON.parse(document.getElementById("figures").textContent);
  const [views] = await Bokeh.embed.embed_items({ page: content }, [{ docid: "page", roots, root_ids: Object.keys(roots) }]);
  const doc = Bokeh.documents[Bokeh.documents.length - 1];
  const figures = doc.roots();
  const figure = (id) => figures.find((one) => `plot-${one.name}` === id);
  const dark = matchMedia("(prefers-color-scheme: dark)");
  const paper = matchMedia("print");
  const touch = matchMedia("(pointer: coarse)");

  // The errors follow from the other maps, so the page does not carry them.
  const maps = doc.get_model_by_name("maps");
  if (maps && maps.data.error) {
    const { truth, estimate, error } = maps.data;
    error[0].forEach((_, place) => { error[0][place] = estimate[0][place] - truth[0][place]; });
    maps.change.emit();
  }

  function colour(printed) {
    const look = dark.matches && !printed ? "dark" : "light";
    const style = getComputedStyle(document.documentElement);
    const of = (name) => style.getPropertyValue(`--${name}-${look}`).trim();
    const [ink, soft, line, back] = ["ink", "soft", "line", "paper"].map(of);
    for (const one of figures) {
      one.outline_line_color = line;
      for (const part of [...one.left, ...one.right, ...one.above, ...one.below, ...one.center]) {
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
          part.setv({ label_text_color: ink, background_fill_color: back, border_line_color: line });
        }
      }
    }
    if (!printed) document.documentElement.dataset.look = look;
  }
  colour(false);
  dark.addEventListener("change", () => colour(false));

  // Browsers print at once, figures follow their page later: so pictures of them, in light colours, lie ready.
  const shown = [...views.roots].filter((one) => figures.includes(one.model));
  let drawing = false;
  let waiting = 0;
  function picture() {
    drawing = true;
    const recolour = document.documentElement.dataset.look === "dark";
    if (recolour) colour(true);
    for (const view of shown) {
      const { width, height } = view.el.getBoundingClientRect();
      if (width === 0 || height === 0) continue;
      if (recolour) view.repaint();
      const print = document.getElementById(`print-${view.model.name}`);
      print.src = view.export("png").canvas.toDataURL();
    }
    if (recolour) {
      colour(false);
      for (const view of shown) view.repaint();
    }
    drawing = false;
    document.documentElement.dataset.printable = "yes";
  }
  function later() {
    if (drawing || paper.matches) return;
    delete document.documentElement.dataset.printable;
    clearTimeout(waiting);
    waiting = setTimeout(picture, 500);
  }
  doc.on_change(later);
  addEventListener("resize", later);
  later();

  // A finger scrolls the page over a map that is whole, and moves a map that is not.
  const whole = new Map(figures.map((one) => [one, [one.x_range, one.y_range].map((range) => [range.start, range.end])]));
  const reset = (one) => [one.x_range, one.y_range].forEach((range, axis) => {
    [range.start, range.end] = whole.get(one)[axis];
  });
  const isWhole = (one) => Math.abs(one.x_range.end - one.x_range.start) >= 0.999 * Math.abs(whole.get(one)[0][1] - whole.get(one)[0][0]);
  function gestures() {
    for (const one of figures) {
      for (const tool of one.toolbar.tools) {
        if (tool.type === "PanTool") tool.active = !touch.matches || !isWhole(one);
        if (tool.type === "WheelZoomTool") tool.active = !touch.matches;
      }
    }
  }
  gestures();
  touch.addEventListener("change", gestures);

  function zoom(one, factor) {
    for (const range of [one.x_range, one.y_range]) {
      const middle = (range.start + range.end) / 2;
      const half = (range.end - range.start) / 2 / factor;
      range.setv({ start: middle - half, end: middle + half });
    }
    if (isWhole(one)) reset(one);
  }
  for (const bar of document.querySelectorAll(".tools")) {
    bar.addEventListener("click", (event) => {
      const button = event.target.closest("button");
      if (!button) return;
      const one = figure(bar.dataset.plot);
      const factor = Number(button.dataset.zoom);
      if (factor === 0) reset(one); else zoom(one, factor);
      gestures();
    });
  }

  const pixel = document.getElementById("pixel");
  if (pixel) {
    const names = Object.keys(maps.data);
    const say = () => {
      const { row, column } = pixel.elements;
      const block = Number(pixel.dataset.block);
      const [rows, columns] = maps.data[names[0]][0].shape;
      const place = [row, column].map((field) => Math.floor(Number(field.value) / block));
      const known = row.value !== "" && column.value !== "" && row.validity.valid && column.validity.valid;
      pixel.querySelector("output").textContent = known && place[0] < rows && place[1] < columns
        ? names.map((name) => `${name} ${maps.data[name][0][place[0] * columns + place[1]].toPrecision(5)}`).join(", ")
        : "no such pixel";
    };
    pixel.addEventListener("input", say);
    pixel.addEventListener("submit", (event) => event.preventDefault());
    say();
  }

  const lens = document.getElementById("lens");
  lens?.addEventListener("change", () => {
    for (const one of document.querySelectorAll(".response")) one.hidden = one.dataset.lens !== lens.value;
    later();
  });
  document.documentElement.dataset.drawn = "yes";
})();
