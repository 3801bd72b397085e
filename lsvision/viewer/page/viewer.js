"use strict";
// The page of a product: OpenSeadragon shows the tiles; places, sections, distances and candidates are in mm.

const byId = (id) => document.getElementById(id);
const state = { info: null, layer: null, viewer: null, candidate: -1, measuring: false, points: [], spans: {} };

async function start() {
  state.info = await (await fetch("info.json")).json();
  document.title = byId("name").textContent = state.info.name;
  for (const layer of state.info.layers) {
    const button = document.createElement("button");
    button.textContent = layer.title;
    button.id = `layer-${layer.name}`;
    button.onclick = () => show(layer);
    byId("layers").append(button, " ");
    state.spans[layer.name] = layer.span;
  }
  state.viewer = OpenSeadragon({
    element: byId("picture"), showNavigationControl: false, showNavigator: true, navigatorPosition: "BOTTOM_RIGHT",
    maxZoomPixelRatio: 12, minZoomImageRatio: 0.8, visibilityRatio: 0.3, imageSmoothingEnabled: false,
    animationTime: 0.4, drawer: "canvas", gestureSettingsMouse: { clickToZoom: false }, crossOriginPolicy: false,
  });
  state.viewer.addHandler("canvas-click", (event) => { if (event.quick) clicked(cellAt(event.position)); });
  state.viewer.addHandler("open", () => { drawMarks(); document.body.dataset.ready = state.layer.name; });
  new OpenSeadragon.MouseTracker({
    element: byId("picture"), moveHandler: (event) => cursor(cellAt(event.position)),
  });
  for (const id of ["low", "high"]) byId(id).onchange = recolor;
  byId("measure").onclick = () => measure(!state.measuring);
  byId("previous").onclick = () => choose(-1);
  byId("next").onclick = () => choose(1);
  byId("candidates").hidden = !state.info.candidates.length;
  which();
  // A link may name a layer and a candidate: #layer=deviation&candidate=3
  const link = new URLSearchParams(location.hash.slice(1));
  show(state.info.layers.find((layer) => layer.name === link.get("layer")) || state.info.layers[0]);
  const chosen = Number(link.get("candidate"));
  if (chosen >= 1 && chosen <= state.info.candidates.length) {
    state.candidate = chosen - 2;
    state.viewer.addOnceHandler("open", () => choose(1));
  }
}

function show(layer) {
  const before = state.layer;
  const view = before && before.sheet === layer.sheet ? state.viewer.viewport.getBounds() : null;
  state.layer = layer;
  for (const other of state.info.layers)
    byId(`layer-${other.name}`).setAttribute("aria-pressed", String(other === layer));
  byId("range").hidden = !layer.unit;
  byId("unit").textContent = layer.unit;
  [byId("low").value, byId("high").value] = state.spans[layer.name].map((value) => Number(value.toPrecision(4)));
  if (before && before.sheet !== layer.sheet) forget();
  open(view);
}

function forget() {
  state.points = [];
  byId("distance").textContent = "Click two points.";
  byId("cursor").textContent = "Move over the picture to read a place; click for a section.";
  for (const id of ["across", "along"]) {
    byId(id).getContext("2d").clearRect(0, 0, byId(id).width, byId(id).height);
    byId(`${id}-title`).textContent = "";
  }
}

function open(view) {
  const layer = state.layer, [low, high] = state.spans[layer.name];
  const range = layer.unit ? `?low=${low}&high=${high}` : "";
  state.viewer.open({
    width: layer.columns, height: layer.rows, tileSize: 256, minLevel: 0, maxLevel: layer.top,
    getTileUrl: (level, x, y) => `tile/${layer.name}/${level}/${x}_${y}.png${range}`,
  });
  if (view) state.viewer.addOnceHandler("open", () => state.viewer.viewport.fitBounds(view, true));
}

function recolor() {
  const low = Number(byId("low").value), high = Number(byId("high").value);
  if (!(high > low)) return;
  state.spans[state.layer.name] = [low, high];
  open(state.viewer.viewport.getBounds());
}

function cellAt(position) {
  const item = state.viewer.world.getItemAt(0);
  if (!item) return null;
  const place = item.viewerElementToImageCoordinates(position);
  const column = Math.floor(place.x), row = Math.floor(place.y), layer = state.layer;
  return row >= 0 && column >= 0 && row < layer.rows && column < layer.columns ? { row, column } : null;
}

function inMm({ row, column }) {
  const layer = state.layer;
  return { along: layer.along_mm + row * layer.pitch_mm, across: layer.across_mm + column * layer.pitch_mm };
}

function cursor(cell) {
  if (!cell) return;
  const { along, across } = inMm(cell), what = state.layer.sheet === "product" ? "across" : "around";
  byId("cursor").textContent = `${along.toFixed(2)} mm along, ${across.toFixed(2)} mm ${what}`;
}

function valued() {
  return state.layer.unit ? state.layer : state.info.layers.find((one) => one.sheet === state.layer.sheet && one.unit);
}

async function clicked(cell) {
  if (!cell) return;
  const layer = valued();
  const answer = await (await fetch(`section/${layer.name}/${cell.row}_${cell.column}.json`)).json();
  const { along, across } = inMm(cell), what = layer.sheet === "product" ? "across" : "around";
  const value = answer.value === null ? "not measured" : `${layer.title} ${answer.value.toFixed(3)} ${layer.unit}`;
  byId("cursor").textContent = `${along.toFixed(2)} mm along, ${across.toFixed(2)} mm ${what}: ${value}`;
  byId("across-title").textContent = `${layer.title} ${what} the ${what === "across" ? "motion" : "object"}, at ${along.toFixed(1)} mm`;
  byId("along-title").textContent = `${layer.title} along the motion, at ${across.toFixed(1)} mm`;
  plot(byId("across"), answer.across, across, layer.unit);
  plot(byId("along"), answer.along, along, layer.unit);
  document.body.dataset.section = `${cell.row}_${cell.column}`;
  if (state.measuring) point({ ...cell, value: answer.value });
}

function plot(canvas, line, here, unit) {
  const ratio = window.devicePixelRatio || 1, width = canvas.clientWidth, height = canvas.clientHeight;
  canvas.width = width * ratio; canvas.height = height * ratio;
  const pen = canvas.getContext("2d"), ink = getComputedStyle(document.body).color;
  pen.scale(ratio, ratio); pen.font = "11px system-ui"; pen.fillStyle = pen.strokeStyle = ink;
  const known = line.values.filter((value) => value !== null);
  if (!known.length) { pen.fillText("not measured", 8, 20); return; }
  let low = known.reduce((a, b) => Math.min(a, b)), high = known.reduce((a, b) => Math.max(a, b));
  if (high - low < 1e-6) { low -= 0.5; high += 0.5; }
  const last = line.first_mm + line.step_mm * (line.values.length - 1);
  const x = (mm) => 44 + (width - 50) * (mm - line.first_mm) / Math.max(last - line.first_mm, 1e-9);
  const y = (value) => 8 + (height - 30) * (high - value) / (high - low);
  pen.globalAlpha = 0.4; pen.strokeRect(44, 8, width - 50, height - 30);
  pen.beginPath(); pen.moveTo(x(here), 8); pen.lineTo(x(here), height - 22); pen.stroke(); pen.globalAlpha = 1;
  pen.fillText(high.toFixed(2), 2, 16); pen.fillText(`${low.toFixed(2)}`, 2, height - 22);
  pen.fillText(unit, 2, height / 2);
  pen.fillText(`${line.first_mm.toFixed(0)} mm`, 44, height - 6);
  pen.textAlign = "right"; pen.fillText(`${last.toFixed(0)} mm`, width - 6, height - 6); pen.textAlign = "left";
  pen.strokeStyle = "#0072b2"; pen.lineWidth = 1.2; pen.beginPath();
  let pending = true;
  line.values.forEach((value, index) => {
    if (value === null) { pending = true; return; }
    const place = [x(line.first_mm + line.step_mm * index), y(value)];
    if (pending) pen.moveTo(...place); else pen.lineTo(...place);
    pending = false;
  });
  pen.stroke();
}

function measure(on) {
  state.measuring = on; state.points = [];
  byId("measure").setAttribute("aria-pressed", String(on));
  byId("distance").hidden = !on;
  byId("distance").textContent = "Click two points.";
  drawMarks();
}

function point(cell) {
  if (state.points.length === 2) state.points = [];
  state.points.push(cell);
  drawMarks();
  if (state.points.length < 2) { byId("distance").textContent = "Click the second point."; return; }
  const [a, b] = state.points, pitch = state.layer.pitch_mm;
  const along = (b.row - a.row) * pitch, across = (b.column - a.column) * pitch, flat = Math.hypot(along, across);
  const depth = a.value === null || b.value === null ? null : b.value - a.value;
  const space = depth === null ? "" : `, ${Math.hypot(flat, depth).toFixed(3)} mm in space (${depth.toFixed(3)} mm in ${valued().title})`;
  const what = state.layer.sheet === "product" ? "across" : "around";
  byId("distance").textContent =
    `${flat.toFixed(3)} mm (${along.toFixed(3)} along, ${across.toFixed(3)} ${what})${space}`;
}

function rectangle(row, column, rows, columns) {
  return state.viewer.world.getItemAt(0).imageToViewportRectangle(column, row, columns, rows);
}

function drawMarks() {
  if (!state.viewer.world.getItemCount()) return;
  state.viewer.clearOverlays();
  if (state.layer.sheet === "surface")
    state.info.candidates.forEach((one, index) => {
      const element = document.createElement("div");
      element.className = `mark ${one.kind}${index === state.candidate ? " chosen" : ""}`;
      element.title = words(one);
      const rows = one.last_row - one.first_row + 1, columns = one.last_column - one.first_column + 1;
      state.viewer.addOverlay({ element, location: rectangle(one.first_row, one.first_column, rows, columns) });
    });
  for (const cell of state.points) {
    const element = document.createElement("div");
    element.className = "point";
    const place = state.viewer.world.getItemAt(0).imageToViewportCoordinates(cell.column + 0.5, cell.row + 0.5);
    state.viewer.addOverlay({ element, location: place });
  }
}

function words(one) {
  const depth = one.depth_mm === null ? "" : `, ${(1000 * one.depth_mm).toFixed(0)} ± ${(1000 * one.depth_sigma_mm).toFixed(0)} µm deep`;
  return `${one.kind} on the ${one.side}, ${one.along_mm.toFixed(1)} mm along, ${one.around_mm.toFixed(1)} mm around` +
    `${depth}, ${one.length_mm.toFixed(1)} x ${one.width_mm.toFixed(1)} mm`;
}

function choose(step) {
  const count = state.info.candidates.length;
  state.candidate = (state.candidate + step + count + (state.candidate < 0 && step < 0 ? 1 : 0)) % count;
  const one = state.info.candidates[state.candidate];
  which();
  const go = () => {
    const rows = one.last_row - one.first_row + 1, columns = one.last_column - one.first_column + 1;
    const box = rectangle(one.first_row - rows, one.first_column - columns, 3 * rows, 3 * columns);
    state.viewer.viewport.fitBounds(box);
    drawMarks();
    clicked({ row: Math.round((one.first_row + one.last_row) / 2), column: Math.round((one.first_column + one.last_column) / 2) });
  };
  if (state.layer.sheet === "surface") go();
  else { state.viewer.addOnceHandler("open", go); show(state.info.layers.find((layer) => layer.name === "deviation")); }
}

function which() {
  const count = state.info.candidates.length;
  byId("which").textContent = state.candidate < 0 ? `${count} in all` : `${state.candidate + 1} of ${count}`;
  byId("about").textContent = state.candidate < 0 ? "" : words(state.info.candidates[state.candidate]);
}

start();
