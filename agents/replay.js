"use strict";
// Draws the replay of one episode: data from the page, plotly for every diagram. Instants are counted by k.

const data = unpacked(JSON.parse(document.getElementById("data").textContent));
const last = data.at.length - 1;
const STEPS_PER_S = 8; // at speed 1
const SPEEDS = [0.25, 0.5, 1, 2, 4, 8];
const ZOOM = 0.6;
const CIRCLE = Array.from({ length: 49 }, (_, i) => (2 * Math.PI * i) / 48);
const touch = matchMedia("(pointer: coarse)").matches;
const state = { k: 0, playing: false, speed: 1, hidden: new Set(), zoom: new Map() };
const drawings = []; // every diagram: {div, draw(k), stale, seen}
const el = (id) => document.getElementById(id);

// -- data ---------------------------------------------------------------------------------------------------------------

// Arrays are base64 of 32-bit floats with a shape; everything else stays as it is.
function unpacked(value) {
  if (value === null || typeof value !== "object") return value;
  if ("f32" in value) return { shape: value.shape, values: floats(value.f32) };
  if (Array.isArray(value)) return value.map(unpacked);
  return Object.fromEntries(Object.entries(value).map(([name, part]) => [name, unpacked(part)]));
}

function floats(text) {
  const bytes = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
  return new Float32Array(bytes.buffer);
}

// Row [c] of thing n in group g of a layer at instant k; layers that never change have one instant.
function row(layer, k, g, n) {
  const [instants, groups, things, columns] = layer.shape;
  const at = (((instants === 1 ? 0 : k) * groups + g) * things + n) * columns;
  return layer.values.subarray(at, at + columns);
}

// Values [k] of column j of a figure [k] or [k, m].
function column(figure, j = 0) {
  const m = figure.shape[1] ?? 1;
  return Array.from({ length: figure.shape[0] }, (_, k) => known(figure.values[k * m + j]));
}

const known = (value) => (Number.isFinite(value) ? value : null);
const mean = (values) => values.reduce((sum, value) => sum + value, 0) / values.length;
const range = (n) => Array.from({ length: n }, (_, i) => i);

function meanFigure(figure, k) {
  const m = figure.shape[1];
  return mean(Array.from(figure.values.subarray(k * m, (k + 1) * m)));
}

function metres(value) {
  if (!Number.isFinite(value)) return "–";
  if (value < 999.5) return `${value.toFixed(0)} m`;
  return value < 99950 ? `${(value / 1e3).toFixed(2)} km` : `${(value / 1e3).toFixed(0)} km`;
}

// -- colours ------------------------------------------------------------------------------------------------------------

function theme(name) {
  return getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim();
}

// Ink and grey follow the page, light or dark; the other colours suit both.
function shade(color) {
  return color === data.ink || color === "#000000" ? theme("ink") : color === data.muted ? theme("mute") : color;
}

function groupColor(style, g) {
  const colors = style.colors.length ? style.colors : data.series;
  return shade(colors[g % colors.length]);
}

function seeThrough(color, opacity) {
  const [r, g, b] = [1, 3, 5].map((i) => parseInt(color.slice(i, i + 2), 16));
  return `rgba(${r},${g},${b},${opacity})`;
}

// -- layers -------------------------------------------------------------------------------------------------------------

const switchOf = (name) => data.styles[name].switch || name;

// Traces of a view at instant k, lower layers first.
function layerTraces(view, k) {
  const traces = [];
  for (const [name, layer] of Object.entries(view.layers)) {
    const style = data.styles[name];
    if (state.hidden.has(switchOf(name))) continue;
    for (const g of range(layer.shape[1])) {
      const color = groupColor(style, g);
      const labels = labelsOf(view, name, g, layer);
      if (style.trail) traces.push(trail(layer, k, g, style, color));
      const trace = SHAPES[style.shape](layer, k, g, style, color, labels);
      traces.push(style.named && view.equal && labels.length > 1 ? { ...trace, ...tags(labels, color) } : trace);
    }
  }
  return traces;
}

// What the things of group g are called; several groups of one thing each share the list of names.
function labelsOf(view, name, g, layer) {
  const names = view.names[name === "estimates off the map" ? "estimates" : name];
  if (!names) return range(layer.shape[2]).map(() => singular(name));
  return layer.shape[1] > 1 ? [names[g]] : names;
}

const singular = (name) => (data.styles[name].switch || name).replace(/([^s])s$/, "$1").replace("hypothese", "hypothesis");

const BASE = { type: "scatter", showlegend: false, cliponaxis: true };

function lineTrace(x, y, style, color, more = {}) {
  return {
    ...BASE, x, y, mode: "lines", hoverinfo: "skip", opacity: style.opacity,
    line: { color, width: style.width, dash: style.dash }, ...more,
  };
}

function markerTrace(rows, labels, tell, marker, more = {}) {
  return {
    ...BASE, mode: "markers", marker, hoverlabel: { namelength: 0 },
    x: rows.map((r) => known(r[0])), y: rows.map((r) => known(r[1])),
    hovertext: rows.map((r, n) => (known(r[0]) === null ? "" : tell(labels[n] ?? labels[0], r))), hovertemplate: "%{hovertext}<extra></extra>", ...more,
  };
}

// Names written beside markers.
function tags(labels, color) {
  return { mode: "markers+text", text: labels.map((label) => label.replace("sensor ", "")), textposition: "top center", textfont: { size: 11, color } };
}

const rowsOf = (layer, k, g) => range(layer.shape[2]).map((n) => row(layer, k, g, n));
const place = (r) => `${r[0].toFixed(2)}, ${r[1].toFixed(2)}`;
const named = (label, r) => `<b>${label}</b><br>at ${place(r)}`;

function trail(layer, k, g, style, color) {
  const x = [], y = [];
  for (const n of range(layer.shape[2])) {
    for (const t of range(k + 1)) {
      const [east, north] = row(layer, t, g, n);
      x.push(known(east));
      y.push(known(north));
    }
    x.push(null);
    y.push(null);
  }
  return lineTrace(x, y, style, color, { opacity: 0.8 });
}

// One function per shape: (layer, k, g, style, color, labels) to a trace. Darts are narrow, with the tip at the place: a
// triangle of equal sides would point three ways.
const SHAPES = {
  dart(layer, k, g, style, color, labels) {
    const rows = rowsOf(layer, k, g);
    const far = (label, r) => (r.length > 3 ? `<b>${label}</b><br>off the map, ${r[3].toFixed(0)} from its middle` : named(label, r));
    return markerTrace(rows, labels, far, {
      color: style.open ? theme("paper") : color, size: style.size, line: { color: style.open ? color : theme("paper"), width: style.open ? 2 : 1 },
      symbol: rows.map((r) => (Number.isFinite(r[2]) ? "arrow" : "circle")),
      angle: rows.map((r) => (Number.isFinite(r[2]) ? 90 - r[2] : 0)),
    });
  },
  dot(layer, k, g, style, color, labels) {
    const rows = rowsOf(layer, k, g);
    const weigh = (label, r) => `<b>${label}</b><br>weight ${r[2].toFixed(3)}<br>at ${place(r)}`;
    return markerTrace(rows, labels, weigh, {
      color, size: rows.map((r) => 3 + 7 * Math.sqrt(known(r[2]) ?? 0)),
      opacity: rows.map((r) => 0.3 + 0.3 * (known(r[2]) ?? 0)), line: { width: 0 },
    });
  },
  ring(layer, k, g, style, color, labels) {
    return markerTrace(rowsOf(layer, k, g), labels, named, {
      symbol: "circle-open", color, size: style.size, line: { color, width: 2.5 },
    });
  },
  cross(layer, k, g, style, color, labels) {
    return markerTrace(rowsOf(layer, k, g), labels, named, {
      symbol: "x-thin", color, size: style.size, line: { color, width: 2.5 },
    });
  },
  site(layer, k, g, style, color, labels) {
    return markerTrace(rowsOf(layer, k, g), labels, named, {
      symbol: "triangle-up", color: style.open ? theme("paper") : color, size: style.size, line: { color, width: 1.5 },
    });
  },
  square(layer, k, g, style, color, labels) {
    return markerTrace(rowsOf(layer, k, g), labels, named, { symbol: "square", color, size: style.size, opacity: 0.6 });
  },
  line(layer, k, g, style, color) {
    const x = [], y = [];
    for (const r of rowsOf(layer, k, g)) {
      x.push(known(r[0]), known(r[2]), null);
      y.push(known(r[1]), known(r[3]), null);
    }
    return lineTrace(x, y, style, color);
  },
  ellipse(layer, k, g, style, color) {
    const x = [], y = [];
    for (const [mx, my, ax, ay, bx, by] of rowsOf(layer, k, g)) {
      for (const a of Number.isFinite(mx + ax + bx) ? CIRCLE : []) {
        x.push(mx + Math.cos(a) * ax + Math.sin(a) * bx);
        y.push(my + Math.cos(a) * ay + Math.sin(a) * by);
      }
      x.push(null);
      y.push(null);
    }
    const area = style.fill ? { fill: "toself", fillcolor: seeThrough(color, style.fill) } : {};
    return lineTrace(x, y, style, color, area);
  },
  path(layer, k, g, style, color) {
    const rows = rowsOf(layer, k, g);
    return lineTrace(rows.map((r) => known(r[0])), rows.map((r) => known(r[1])), style, color);
  },
};

// -- diagrams -----------------------------------------------------------------------------------------------------------

function axis(title, more = {}) {
  return {
    title: { text: title, font: { size: 12 }, standoff: 6 }, gridcolor: theme("grid"), zeroline: false, linecolor: theme("line"),
    tickfont: { size: 11 }, ...more,
  };
}

function layoutOf(more) {
  return {
    paper_bgcolor: theme("paper"), plot_bgcolor: theme("paper"), font: { color: theme("ink"), family: "system-ui, sans-serif" },
    margin: { l: 52, r: 10, t: 8, b: 40 }, hoverlabel: { align: "left" }, showlegend: false, ...more,
  };
}

const CONFIG = { displaylogo: false, responsive: true, doubleClick: false, displayModeBar: false };
// Tools of the large diagrams, shown while a pointer is over them.
const TOOLS = { ...CONFIG, displayModeBar: touch ? false : "hover", modeBarButtons: [["toImage", "zoom2d", "pan2d"]] };

function viewLayout(view, v, k) {
  const [west, south, east, north] = boundsOf(view, v, k);
  const same = view.equal ? { scaleanchor: "x", scaleratio: 1, constrain: "domain" } : {};
  return layoutOf({
    dragmode: touch ? false : "pan", uirevision: "kept",
    xaxis: axis(view.axes[0], { range: [west, east], constrain: "domain" }),
    yaxis: axis(view.axes[1], { range: [south, north], ...same }),
  });
}

// West, south, east, north of a view: following the instant, zoomed, or all of it.
function boundsOf(view, v, k) {
  if (view.reach) {
    const reach = view.reach.values[k];
    return [-reach, -reach, reach, reach];
  }
  return state.zoom.get(v) ?? view.frame;
}

// A diagram that is drawn when it comes into sight, and again when something has changed since.
function addDrawing(div, draw) {
  const drawing = { div, draw, stale: true, seen: false };
  drawings.push(drawing);
  onSight.observe(div);
  div.drawing = drawing;
}

function refresh(drawing) {
  if (!drawing.seen || !drawing.stale) return;
  drawing.stale = false;
  drawing.draw(state.k);
  el("js-plotly-tester")?.setAttribute("aria-hidden", "true"); // plotly's own, where it measures texts
}

const onSight = new IntersectionObserver((entries) => {
  for (const entry of entries) {
    entry.target.drawing.seen = entry.isIntersecting;
    refresh(entry.target.drawing);
  }
  // The page answers once everything in sight is drawn for the first time.
  document.documentElement.dataset.readyMs ??= Math.round(performance.now());
}, { rootMargin: "100px" });

function addView(parent, policy, view, v) {
  const div = addPlot(v ? parent.appendChild(captioned(view.name)) : parent, `${view.name}, ${policy.name}`);
  const [west, south, east, north] = view.frame ?? [];
  div.parentNode.classList.add(view.equal ? "equal" : "side");
  if (view.equal && view.frame) div.parentNode.style.aspectRatio = (east - west) / (north - south);
  let wired = false;
  addDrawing(div, (k) => {
    Plotly.react(div, layerTraces(view, k), viewLayout(view, v, k), v ? CONFIG : TOOLS);
    if (wired || view.reach) return;
    wired = true;
    div.on("plotly_relayout", (change) => followZoom(v, change));
    div.on("plotly_doubleclick", () => setZoom(null));
  });
}

// A picture with a name for screen readers; the drawing's own parts would tell them nothing.
function addPlot(parent, label) {
  const picture = document.createElement("div"), div = document.createElement("div");
  picture.className = "plot";
  picture.setAttribute("role", "img");
  picture.setAttribute("aria-label", label);
  div.setAttribute("aria-hidden", "true");
  picture.append(div);
  parent.append(picture);
  return div;
}

function captioned(text) {
  const figure = document.createElement("figure");
  figure.append(cell("figcaption", text));
  return figure;
}

// Zooming or panning one map moves the same map of the other policies.
function followZoom(v, change) {
  const bounds = ["xaxis.range[0]", "yaxis.range[0]", "xaxis.range[1]", "yaxis.range[1]"].map((name) => change[name]);
  if (bounds.some((bound) => bound === undefined)) return;
  state.zoom.set(v, bounds);
  redraw();
}

// A diagram over time with its title and key above; row: {title, lines: [[name, color, dash]], traces(), yaxis}.
function addTimeDiagram(parent, row, label, height) {
  const figure = captioned("");
  figure.firstChild.innerHTML = `<b>${row.title}</b> ${row.lines.map(sampleOfLine).join(" ")}`;
  parent.append(figure);
  const div = addPlot(figure, `${row.title} over time, ${label}`);
  div.parentNode.style.height = height;
  let drawn = false;
  addDrawing(div, (k) => {
    if (drawn) return Plotly.relayout(div, { shapes: [cursor(k)] });
    drawn = true;
    Plotly.react(div, row.traces(), timeLayout(row), CONFIG);
    div.on("plotly_click", (event) => seek(nearest(event.points[0].x)));
    return undefined;
  });
}

function timeLayout(row) {
  return layoutOf({
    hovermode: "x unified", dragmode: false, shapes: [cursor(state.k)], margin: { l: 52, r: 10, t: 6, b: 36 },
    xaxis: axis(data.axis, { range: [data.at[0], Math.max(data.at[last], data.at[0] + 1)], fixedrange: true }),
    yaxis: axis("", { ...row.yaxis, fixedrange: true }),
  });
}

function sampleOfLine([name, color, dash]) {
  const strokes = { solid: "", dash: "5 3" };
  const line = `<line x1="0" y1="5" x2="20" y2="5" stroke="${shade(color)}" stroke-width="2.5" stroke-dasharray="${strokes[dash]}"/>`;
  return `<span class="line"><svg viewBox="0 0 20 10" aria-hidden="true">${line}</svg>${escaped(name)}</span>`;
}

function escaped(text) {
  const span = document.createElement("span");
  span.textContent = text;
  return span.innerHTML;
}

function cursor(k) {
  const x = data.at[k];
  return { type: "line", xref: "x", yref: "paper", x0: x, x1: x, y0: 0, y1: 1, line: { color: theme("ink"), width: 1.5 } };
}

function nearest(at) {
  let best = 0;
  data.at.forEach((value, k) => {
    if (Math.abs(value - at) < Math.abs(data.at[best] - at)) best = k;
  });
  return best;
}

// -- series over time ---------------------------------------------------------------------------------------------------

function series(name, y, color, tell, line = {}) {
  return { ...BASE, name, x: data.at, y, mode: y.length > 1 ? "lines" : "markers", line: { color: shade(color), width: 2, ...line }, hovertemplate: tell };
}

const TELL_METRES = "%{y:.3s}m";
const DASHED = { dash: "dash", width: 1.4 };
const BOUND = ["Cramér–Rao bound (PCRLB, 1σ)", data.muted, "dash"];
const seriesColor = (i) => data.series[i % data.series.length];

// Positions on a logarithmic axis must be positive.
const positive = (values) => values.map((value) => (value > 0 ? value : null));

function errorAxis(kind) {
  return { type: "log", range: data.limits[kind].map(Math.log10), tickformat: "~s", ticksuffix: "m", dtick: 1, minor: { showgrid: true, gridcolor: theme("grid"), griddash: "dot" } };
}

function errorRow(policy, kind) {
  const [error, bound] = policy.errors[kind];
  const m = error.shape[1];
  const of = (j) => (m > 1 ? ` of target ${j + 1}` : "");
  return {
    title: `${capital(kind)} error`, yaxis: errorAxis(kind),
    lines: [...(m > 1 ? range(m).map((j) => [`target ${j + 1}`, seriesColor(j), "solid"]) : []), BOUND],
    traces: () => range(m).flatMap((j) => [
      series(`error${of(j)}`, positive(column(error, j)), seriesColor(j), TELL_METRES),
      series(`bound${of(j)}`, positive(column(bound, j)), seriesColor(j), TELL_METRES, DASHED),
    ]),
  };
}

// Lines by name, each with a colour and a dash of its own.
function namedRow(title, figures, yaxis) {
  const lines = Object.keys(figures).map((name, i) => [words(name), seriesColor(i), i < data.series.length ? "solid" : "dash"]);
  return {
    title, lines, yaxis,
    traces: () => Object.values(figures).map((values, i) => {
      const [name, color, dash] = lines[i];
      return series(name, column(values), color, "%{y:.3f}", { dash });
    }),
  };
}

const words = (term) => term.replaceAll("_", " ");
const capital = (word) => word[0].toUpperCase() + word.slice(1);

function diagramRows(policy) {
  const rows = Object.keys(policy.errors).map((kind) => errorRow(policy, kind));
  rows.push(namedRow("Reward of each step", policy.rewards, {}));
  if (Object.keys(policy.probabilities).length) rows.push(namedRow("Probability", policy.probabilities, { range: [-0.02, 1.02] }));
  return rows;
}

function togetherRow(kind) {
  const averaged = (figure) => range(data.at.length).map((k) => meanFigure(figure, k));
  return {
    title: `${capital(kind)} error, mean over targets`, yaxis: errorAxis(kind),
    lines: [...data.policies.map((policy) => [policy.name, policy.color, "solid"]), BOUND],
    traces: () => data.policies.flatMap((policy) => [
      series(policy.name, positive(averaged(policy.errors[kind][0])), policy.color, TELL_METRES),
      series(`${policy.name}, bound`, positive(averaged(policy.errors[kind][1])), policy.color, TELL_METRES, DASHED),
    ]),
  };
}

// -- figures in words ---------------------------------------------------------------------------------------------------

// Sum of all rewards [k] up to every instant.
function earned(policy) {
  let sum = 0;
  const terms = Object.values(policy.rewards);
  return range(data.at.length).map((k) => (sum += terms.reduce((all, term) => all + (known(term.values[k]) ?? 0), 0)));
}

const earnings = data.policies.map(earned);

function figureRows(k) {
  return data.policies.map((policy, i) => {
    const errors = Object.values(policy.errors).flatMap((pair) => pair.map((part) => metres(meanFigure(part, k))));
    return [...errors, earnings[i][k].toFixed(2)];
  });
}

function showFigures(k) {
  const kinds = Object.keys(data.policies[0].errors);
  const head = ["policy", ...kinds.flatMap((kind) => [`${kind} error`, "PCRLB, 1σ"]), "reward so far"];
  const table = el("figures");
  if (!table.tHead) {
    const cells = table.createTHead().insertRow();
    head.forEach((text) => cells.append(cell("th", text, "col")));
    const body = table.createTBody();
    for (const policy of data.policies) {
      const line = body.insertRow(), name = cell("th", policy.name, "row");
      name.prepend(swatch(policy.color));
      line.append(name);
      head.slice(1).forEach(() => line.insertCell());
    }
  }
  figureRows(k).forEach((texts, i) => texts.forEach((text, j) => { table.tBodies[0].rows[i].cells[j + 1].textContent = text; }));
}

function cell(tag, text, scope) {
  const made = document.createElement(tag);
  made.textContent = text;
  if (scope) made.scope = scope;
  return made;
}

function swatch(color) {
  const made = document.createElement("span");
  made.className = "swatch";
  made.style.background = shade(color);
  return made;
}

// Spoken by screen readers when the replay stands still.
function tell() {
  const kind = Object.keys(data.policies[0].errors)[0];
  const told = data.policies.map((policy) => `${policy.name}: ${kind} error ${metres(meanFigure(policy.errors[kind][0], state.k))}`);
  el("status").textContent = `${data.labels[state.k]}. ${told.join("; ")}.`;
}

// -- time ---------------------------------------------------------------------------------------------------------------

function seek(k) {
  state.k = Math.min(Math.max(k, 0), last);
  redraw();
  if (!state.playing) tell();
}

function redraw() {
  el("time").value = state.k;
  el("time").setAttribute("aria-valuetext", data.labels[state.k]);
  el("clock").textContent = data.labels[state.k];
  showFigures(state.k);
  for (const drawing of drawings) {
    drawing.stale = true;
    refresh(drawing);
  }
}

let began = null; // when and where playing began: {time, k}

function play(on) {
  state.playing = on;
  el("play").textContent = on ? "Pause" : "Play";
  if (on && state.k === last) seek(0);
  began = null;
  if (on) requestAnimationFrame(frame);
  else tell();
}

function frame(time) {
  if (!state.playing) return;
  began ??= { time, k: state.k };
  const k = began.k + Math.floor(((time - began.time) / 1e3) * STEPS_PER_S * state.speed);
  if (k > state.k) seek(k);
  if (state.k === last) play(false);
  else requestAnimationFrame(frame);
}

function setSpeed(speed) {
  state.speed = speed;
  el("speed").value = speed;
  began = null;
}

function changeSpeed(by) {
  const at = SPEEDS.indexOf(state.speed) + by;
  if (SPEEDS[at]) setSpeed(SPEEDS[at]);
}

// -- zoom ---------------------------------------------------------------------------------------------------------------

function setZoom(zoom) {
  if (zoom === null) state.zoom.clear();
  redraw();
}

// Maps shrink or grow about the middle of the true targets, those of one view for all policies alike.
function zoomBy(factor) {
  data.policies[0].views.forEach((view, v) => {
    if (view.reach) return;
    const [west, south, east, north] = boundsOf(view, v, state.k);
    const [x, y] = factor < 1 && !state.zoom.has(v) ? targetsMiddle(view) : [(west + east) / 2, (south + north) / 2];
    const [w, h] = [(factor * (east - west)) / 2, (factor * (north - south)) / 2];
    state.zoom.set(v, [x - w, y - h, x + w, y + h]);
  });
  redraw();
}

function targetsMiddle(view) {
  const layer = view.layers["true targets"];
  const rows = range(layer.shape[1]).map((g) => row(layer, state.k, g, 0));
  return [mean(rows.map((r) => r[0])), mean(rows.map((r) => r[1]))];
}

// -- the page -----------------------------------------------------------------------------------------------------------

function addSwitches() {
  const shown = new Set(data.policies.flatMap((policy) => policy.views.flatMap((view) => Object.keys(view.layers))));
  const switches = new Map();
  for (const name of Object.keys(data.styles).reverse()) {
    if (shown.has(name) && (!switches.has(switchOf(name)) || name === switchOf(name))) switches.set(switchOf(name), data.styles[name]);
  }
  for (const [name, style] of switches) el("layers").append(chip(name, style));
}

function chip(name, style) {
  const label = document.createElement("label"), box = document.createElement("input");
  label.className = "chip";
  box.type = "checkbox";
  box.checked = true;
  box.dataset.layer = name;
  box.addEventListener("change", () => {
    if (box.checked) state.hidden.delete(name);
    else state.hidden.add(name);
    redraw();
  });
  label.append(box);
  label.insertAdjacentHTML("beforeend", sample(style));
  label.append(name);
  return label;
}

// A sample of a layer's look, as SVG; colours are the page's own.
function sample(style) {
  const color = groupColor(style, 0), dash = { dash: "5 3", dot: "2 2" }[style.dash] ?? "";
  const line = `stroke="${color}" stroke-width="2" stroke-dasharray="${dash}" fill="none"`;
  const hollow = `fill="${style.open ? "none" : color}" stroke="${color}" stroke-width="1.5"`;
  const shapes = {
    dart: `<path d="M2 8H14" ${style.trail ? line : ""}/><path d="M13 3L22 8L13 13Z" ${hollow}/>`,
    dot: `<circle cx="7" cy="8" r="2" fill="${color}" opacity="0.5"/><circle cx="16" cy="8" r="5" fill="${color}" opacity="0.8"/>`,
    ring: `<circle cx="12" cy="8" r="5.5" ${line}/>`,
    cross: `<path d="M7 3L17 13M17 3L7 13" ${line}/>`,
    site: `<path d="M6 13L12 3L18 13Z" ${hollow}/>`,
    square: `<rect x="5" y="1" width="14" height="14" fill="${color}" opacity="0.6"/>`,
    line: `<path d="M2 12L22 4" ${line}/>`,
    path: `<path d="M2 12Q10 0 22 6" ${line}/>`,
    ellipse: `<ellipse cx="12" cy="8" rx="10" ry="5" ${line.replace('fill="none"', `fill="${style.fill ? seeThrough(color, style.fill) : "none"}"`)}/>`,
  };
  return `<svg viewBox="0 0 24 16" aria-hidden="true">${shapes[style.shape]}</svg>`;
}

function addPolicy(policy) {
  const map = document.createElement("article"), title = cell("h3", policy.name);
  title.prepend(swatch(policy.color));
  map.append(title);
  const small = document.createElement("div");
  small.className = "small";
  policy.views.forEach((view, v) => addView(v > 0 && view.equal ? small : map, policy, view, v));
  if (small.children.length) map.append(small);
  el("maps").append(map);
  const below = document.createElement("article");
  below.append(title.cloneNode(true));
  diagramRows(policy).forEach((row) => addTimeDiagram(below, row, policy.name, "9.5rem"));
  el("diagrams").append(below);
}

function addTogether() {
  if (data.policies.length < 2) return;
  el("together").hidden = false;
  addTimeDiagram(el("together"), togetherRow(Object.keys(data.policies[0].errors)[0]), "all policies", "17rem");
}

function wireControls() {
  el("time").max = last;
  el("time").addEventListener("input", () => seek(Number(el("time").value)));
  const actions = {
    play: () => play(!state.playing), first: () => seek(0), last: () => seek(last), back: () => seek(state.k - 1),
    next: () => seek(state.k + 1), closer: () => zoomBy(ZOOM), farther: () => zoomBy(1 / ZOOM), fit: () => setZoom(null),
  };
  for (const [id, action] of Object.entries(actions)) {
    el(id).addEventListener("click", () => {
      if (id !== "play" && !["closer", "farther", "fit"].includes(id)) play(false);
      action();
    });
  }
  for (const speed of SPEEDS) el("speed").append(new Option(`${speed}×`, speed));
  el("speed").addEventListener("change", () => setSpeed(Number(el("speed").value)));
  setSpeed(1);
  document.addEventListener("keydown", onKey);
}

// Keys of the page; those that a focused control uses itself are left to it.
function onKey(event) {
  if (event.ctrlKey || event.metaKey || event.altKey) return;
  const stride = event.shiftKey ? 10 : 1;
  const keys = {
    " ": () => play(!state.playing), ArrowLeft: () => seek(state.k - stride), ArrowRight: () => seek(state.k + stride),
    Home: () => seek(0), End: () => seek(last), "<": () => changeSpeed(-1), ">": () => changeSpeed(1),
    z: () => zoomBy(ZOOM), x: () => zoomBy(1 / ZOOM), f: () => setZoom(null),
  };
  const action = keys[event.key];
  const own = event.target.matches("button, select, summary, input[type=checkbox]") ? [" ", ...(event.target.matches("select") ? Object.keys(keys) : [])] : [];
  if (!action || own.includes(event.key)) return;
  event.preventDefault();
  action();
}

addSwitches();
data.policies.forEach(addPolicy);
addTogether();
wireControls();
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => location.reload());
seek(0);
