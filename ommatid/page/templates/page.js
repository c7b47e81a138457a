"use strict";
// Draws the maps of a page on canvases, and connects them: zoom, pointer, comparison, values and files to save.
(async () => {
  const content = JSON.parse(document.getElementById("figures").textContent);
  const TYPES = { float32: Float32Array };
  const LARGEST_ZOOM = 64; // screen pixels of a pixel of the image, about
  const NEAR = 14; // screen pixels from the line between two images, in which it is caught

  async function decode({ dtype, shape, data }) {
    const bytes = Uint8Array.from(atob(data), (letter) => letter.charCodeAt(0));
    const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
    return { shape, values: new TYPES[dtype](await new Response(stream).arrayBuffer()) };
  }

  function colours(name) {
    const anchors = content.palettes[name].map((text) => [1, 3, 5].map((at) => parseInt(text.slice(at, at + 2), 16)));
    return Uint8ClampedArray.from({ length: 1024 }, (_, index) => {
      const place = ((index >> 2) / 255) * (anchors.length - 1);
      const first = Math.min(Math.floor(place), anchors.length - 2);
      const channel = index & 3;
      return channel === 3 ? 255 : anchors[first][channel] * (1 - place + first) + anchors[first + 1][channel] * (place - first);
    });
  }
  const missing = [1, 3, 5].map((at) => parseInt(content.missing.slice(at, at + 2), 16));

  // A picture of values with the colours of a scale; NaN marks pixels without a value.
  function raster(values, columns, rows, { palette, low, high }) {
    const canvas = document.createElement("canvas");
    [canvas.width, canvas.height] = [columns, rows];
    const context = canvas.getContext("2d");
    const picture = context.createImageData(columns, rows);
    const table = colours(palette);
    for (let index = 0; index < values.length; index++) {
      const at = 4 * index;
      if (Number.isNaN(values[index])) {
        picture.data.set([...missing, 255], at);
      } else {
        const share = (values[index] - low) / (high - low);
        const entry = 4 * Math.round(255 * Math.min(Math.max(share, 0), 1));
        for (let channel = 0; channel < 4; channel++) picture.data[at + channel] = table[entry + channel];
      }
    }
    context.putImageData(picture, 0, 0);
    return canvas;
  }

  // Canvases that show the same part of one area: left, top, width and height in its units.
  class View {
    constructor(name, left, top, width, height) {
      Object.assign(this, { name, whole: { left, top, width, height }, canvases: [], pointer: null, divider: 0.5, changed: [] });
      this.reset();
    }
    reset() { Object.assign(this, this.whole); }
    get isWhole() { return this.width >= 0.999 * this.whole.width; }
    zoom(factor, x = this.left + this.width / 2, y = this.top + this.height / 2) {
      const smallest = this.whole.width / Math.max(1, this.whole.width * LARGEST_ZOOM / 400);
      const width = Math.min(Math.max(this.width / factor, smallest), this.whole.width);
      const ratio = width / this.width;
      this.left = x - (x - this.left) * ratio;
      this.top = y - (y - this.top) * ratio;
      this.width *= ratio;
      this.height *= ratio;
      this.keepInside();
    }
    move(across, down) {
      this.left += across;
      this.top += down;
      this.keepInside();
    }
    keepInside() {
      const { left, top, width, height } = this.whole;
      this.left = Math.min(Math.max(this.left, left), left + width - this.width);
      this.top = Math.min(Math.max(this.top, top), top + height - this.height);
    }
    // Screen pixels of a canvas per unit, and the margins where its shape is another than that of the area.
    fit(canvas) {
      const box = canvas.getBoundingClientRect();
      const scale = Math.min(box.width / this.width, box.height / this.height);
      return { scale, x: (box.width - scale * this.width) / 2, y: (box.height - scale * this.height) / 2, box };
    }
    place(canvas, event) {
      const { scale, x, y, box } = this.fit(canvas);
      return [this.left + (event.clientX - box.left - x) / scale, this.top + (event.clientY - box.top - y) / scale];
    }
    draw() {
      for (const canvas of this.canvases) {
        const { scale, x, y, box } = this.fit(canvas);
        if (box.width === 0) continue;
        const dense = window.devicePixelRatio || 1;
        const [width, height] = [Math.round(box.width * dense), Math.round(box.height * dense)];
        if (canvas.width !== width || canvas.height !== height) [canvas.width, canvas.height] = [width, height];
        const context = canvas.getContext("2d");
        context.setTransform(1, 0, 0, 1, 0, 0);
        context.clearRect(0, 0, width, height);
        context.setTransform(dense * scale, 0, 0, dense * scale, dense * (x - scale * this.left), dense * (y - scale * this.top));
        context.imageSmoothingEnabled = false;
        canvas.paint(context, this);
        if (this.pointer) {
          context.strokeStyle = "#ff2d78";
          context.lineWidth = 1 / scale;
          context.beginPath();
          context.moveTo(this.left, this.pointer[1]);
          context.lineTo(this.left + this.width, this.pointer[1]);
          context.moveTo(this.pointer[0], this.top);
          context.lineTo(this.pointer[0], this.top + this.height);
          context.stroke();
        }
        canvas.style.touchAction = this.isWhole ? "pan-y" : "none";
      }
      for (const react of this.changed) react();
    }
  }
  const views = new Map();
  window.ommatid = { views };

  function connect(canvas, view) {
    const fingers = new Map();
    let catching = false;
    const middle = () => {
      const places = [...fingers.values()];
      const [x, y] = [0, 1].map((axis) => places.reduce((sum, place) => sum + place[axis], 0) / places.length);
      const apart = places.length > 1 ? Math.hypot(places[0][0] - places[1][0], places[0][1] - places[1][1]) : 0;
      return { x, y, apart };
    };
    const divide = (event) => {
      const { box } = view.fit(canvas);
      view.divider = Math.min(Math.max((event.clientX - box.left) / box.width, 0), 1);
    };
    canvas.addEventListener("pointerdown", (event) => {
      const { box } = view.fit(canvas);
      catching = canvas.dataset.map === "compare" && fingers.size === 0
        && Math.abs(event.clientX - box.left - view.divider * box.width) < NEAR;
      fingers.set(event.pointerId, [event.clientX, event.clientY]);
      canvas.setPointerCapture(event.pointerId);
    });
    canvas.addEventListener("pointermove", (event) => {
      if (!fingers.has(event.pointerId)) {
        view.pointer = event.pointerType === "mouse" ? view.place(canvas, event) : null;
      } else if (catching) {
        divide(event);
      } else {
        const before = middle();
        fingers.set(event.pointerId, [event.clientX, event.clientY]);
        const after = middle();
        const { scale } = view.fit(canvas);
        if (before.apart > 0 || !view.isWhole) view.move((before.x - after.x) / scale, (before.y - after.y) / scale);
        if (before.apart > 0 && after.apart > 0) {
          const [x, y] = view.place(canvas, { clientX: after.x, clientY: after.y });
          view.zoom(after.apart / before.apart, x, y);
        }
      }
      view.draw();
    });
    const release = (event) => { fingers.delete(event.pointerId); catching = false; };
    canvas.addEventListener("pointerup", (event) => {
      if (event.pointerType !== "mouse" && fingers.size === 1) view.pointer = view.place(canvas, event);
      release(event);
      view.draw();
    });
    canvas.addEventListener("pointercancel", release);
    canvas.addEventListener("pointerleave", () => { if (!fingers.size) { view.pointer = null; view.draw(); } });
    canvas.addEventListener("touchstart", (event) => {
      if (event.touches.length > 1 || !view.isWhole) event.preventDefault();
    }, { passive: false });
    canvas.addEventListener("wheel", (event) => {
      if (!event.ctrlKey) return;
      event.preventDefault();
      view.zoom(Math.exp(-event.deltaY / 300), ...view.place(canvas, event));
      view.draw();
    }, { passive: false });
    canvas.addEventListener("keydown", (event) => {
      const step = view.width / 10;
      const keys = {
        "+": () => view.zoom(1.5), "-": () => view.zoom(1 / 1.5), 0: () => view.reset(),
        ArrowLeft: () => view.move(-step, 0), ArrowRight: () => view.move(step, 0),
        ArrowUp: () => view.move(0, -step), ArrowDown: () => view.move(0, step),
      };
      if (!keys[event.key] || event.ctrlKey || event.metaKey || (event.key.startsWith("Arrow") && view.isWhole)) return;
      event.preventDefault();
      keys[event.key]();
      view.draw();
    });
  }

  // --- maps

  const maps = new Map();
  async function addMaps(group) {
    const decoded = new Map();
    for (const map of group.maps) if (map.values) decoded.set(map.name, await decode(map.values));
    for (const map of group.maps) {
      if (map.difference) {
        const [first, second] = map.difference.map((name) => decoded.get(name));
        decoded.set(map.name, { shape: first.shape, values: first.values.map((value, index) => value - second.values[index]) });
      }
      const { shape, values } = decoded.get(map.name);
      const picture = raster(values, shape[1], shape[0], map.scale);
      maps.set(map.name, { ...map, shape, values, picture, block: group.block });
    }
    const [rows, columns] = decoded.values().next().value.shape;
    const view = new View(group.name, 0, 0, columns, rows);
    views.set(group.name, view);
    for (const canvas of document.querySelectorAll(`canvas[data-group="${group.name}"]`)) {
      const { map } = canvas.dataset;
      canvas.paint = map === "compare" ? compare(canvas) : (context) => context.drawImage(maps.get(map).picture, 0, 0);
      view.canvases.push(canvas);
      connect(canvas, view);
    }
  }

  function compare(canvas) {
    const [left, right] = ["left", "right"].map((side) => canvas.parentElement.querySelector(`[data-side=${side}]`));
    const slider = document.getElementById("divider");
    for (const choice of [left, right]) choice.addEventListener("change", () => views.get("maps").draw());
    slider.addEventListener("input", () => {
      views.get("maps").divider = Number(slider.value) / 1000;
      views.get("maps").draw();
    });
    return (context, view) => {
      const { scale, x, box } = view.fit(canvas);
      const at = view.left + (view.divider * box.width - x) / scale;
      for (const [choice, start, end] of [[left, view.left, at], [right, at, view.left + view.width]]) {
        context.save();
        context.beginPath();
        context.rect(start, view.top, Math.max(end - start, 0), view.height);
        context.clip();
        context.drawImage(maps.get(choice.value).picture, 0, 0);
        context.restore();
      }
      for (const [colour, width] of [["#000", 4], ["#fff", 2]]) {
        context.fillStyle = colour;
        context.fillRect(at - width / 2 / scale, view.top, width / scale, view.height);
      }
      slider.value = String(Math.round(1000 * view.divider));
    };
  }

  function connectPixel(form) {
    const view = views.get("maps");
    const { row, column } = form.elements;
    const shown = content.groups.find((group) => group.name === "maps").maps.map((map) => maps.get(map.name));
    const showValues = () => {
      const { block, shape } = shown[0];
      const [i, j] = [row, column].map((field) => Math.floor(Number(field.value) / block));
      const valid = row.value !== "" && column.value !== "" && row.validity.valid && column.validity.valid;
      form.querySelector("output").textContent = valid && i < shape[0] && j < shape[1]
        ? shown.map((map) => `${map.title.toLowerCase()} ${map.values[i * shape[1] + j].toPrecision(4)}`).join(", ")
        : "outside the image";
    };
    view.changed.push(() => {
      if (!view.pointer) return;
      const { block } = shown[0];
      const [x, y] = view.pointer.map((place) => Math.floor(place * block));
      const [rows, columns] = [Number(row.max), Number(column.max)];
      column.value = String(Math.min(Math.max(x, 0), columns));
      row.value = String(Math.min(Math.max(y, 0), rows));
      showValues();
    });
    form.addEventListener("input", showValues);
    form.addEventListener("submit", (event) => event.preventDefault());
    for (const button of form.querySelectorAll("[data-save]")) {
      button.addEventListener("click", () => save(maps.get(form.elements.map.value), button.dataset.save));
    }
    showValues();
  }

  // --- files

  function npy({ shape, values }) {
    const header = `{'descr': '<f4', 'fortran_order': False, 'shape': (${shape[0]}, ${shape[1]}), }`;
    const size = 64 * Math.ceil((10 + header.length + 1) / 64) - 10;
    const text = `\x93NUMPY\x01\x00${String.fromCharCode(size & 255, size >> 8)}${header.padEnd(size - 1)}\n`;
    return [Uint8Array.from(text, (letter) => letter.charCodeAt(0)), values];
  }
  function csv({ shape, values }) {
    const lines = Array.from({ length: shape[0] }, (_, row) => values.slice(row * shape[1], (row + 1) * shape[1]).join(","));
    return [`${lines.join("\n")}\n`];
  }
  async function save(map, kind) {
    const parts = kind === "png" ? null : { npy, csv }[kind](map);
    const blob = parts ? new Blob(parts) : await new Promise((done) => map.picture.toBlob(done, "image/png"));
    const link = document.createElement("a");
    link.href = URL.createObjectURL(blob);
    link.download = `${map.name}.${kind}`;
    link.click();
    URL.revokeObjectURL(link.href);
  }

  for (const group of content.groups) await addMaps(group);
  const drawAll = () => { for (const view of views.values()) view.draw(); };
  for (const bar of document.querySelectorAll(".tools")) {
    bar.addEventListener("click", (event) => {
      const factor = Number(event.target.closest("button")?.dataset.zoom ?? NaN);
      const view = views.get(bar.dataset.group);
      if (Number.isNaN(factor)) return;
      if (factor === 0) view.reset(); else view.zoom(factor);
      view.draw();
    });
  }
  const pixel = document.querySelector("form.pixel");
  if (pixel) connectPixel(pixel);
  for (const fold of document.querySelectorAll("details")) fold.addEventListener("toggle", drawAll);
  addEventListener("resize", drawAll);
  addEventListener("hashchange", () => document.querySelector(`details${location.hash}`)?.setAttribute("open", ""));
  drawAll();
  document.documentElement.dataset.ready = "yes";
})();
