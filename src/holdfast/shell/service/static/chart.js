"use strict";
/* A line with a band over time, as an SVG of its own; a few hundred points, drawn anew each time. */

const SVG = "http://www.w3.org/2000/svg";
const WIDTH = 300;
const HEIGHT = 100;

function short(value) {
  if (value === null || value === undefined) return "none";
  const size = Math.abs(value);
  if (size !== 0 && (size >= 1e5 || size < 1e-3)) return value.toExponential(2);
  return String(Number(value.toPrecision(4)));
}

class Chart {
  /* `read(row)` gives { value, sd, limit, alarm }; null where there is nothing to show. */
  constructor(parent, name, read) {
    this.read = read;
    this.name = name;
    const figure = document.createElement("figure");
    const caption = document.createElement("figcaption");
    const title = document.createElement("span");
    title.textContent = name;
    this.output = document.createElement("output");
    caption.append(title, this.output);
    this.svg = document.createElementNS(SVG, "svg");
    this.svg.setAttribute("viewBox", `0 0 ${WIDTH} ${HEIGHT}`);
    this.svg.setAttribute("preserveAspectRatio", "none");
    this.svg.setAttribute("role", "img");
    this.scale = document.createElement("div");
    this.scale.className = "scale";
    this.range = document.createElement("span");
    this.span = document.createElement("span");
    this.scale.append(this.range, this.span);
    figure.append(caption, this.svg, this.scale);
    parent.append(figure);
  }

  draw(rows) {
    const points = rows.map((row) => ({ frame: row.frame, time: row.time, ...this.read(row) }));
    const values = [];
    for (const p of points) {
      if (p.value === null) continue;
      const sd = p.sd || 0;
      values.push(p.value - 2 * sd, p.value + 2 * sd);
      if (p.limit !== null && p.limit !== undefined) values.push(p.limit);
    }
    this.svg.replaceChildren();
    if (values.length === 0) {
      this.output.textContent = "nothing to show";
      return;
    }
    const [low, high] = padded(Math.min(...values), Math.max(...values));
    const first = points[0].frame;
    const length = Math.max(points[points.length - 1].frame - first, 1);
    const x = (p) => ((p.frame - first) / length) * WIDTH;
    const y = (value) => HEIGHT * (1 - (value - low) / (high - low));
    this.shade(points, x);
    if (low < 0 && high > 0) {
      this.add("line", { x1: 0, x2: WIDTH, y1: y(0).toFixed(1), y2: y(0).toFixed(1) }, "zero");
    }
    for (const run of runs(points)) this.run(run, x, y);
    this.limits(points, x, y);
    this.say(points, low, high);
  }

  add(kind, attributes, className) {
    const part = document.createElementNS(SVG, kind);
    for (const [key, value] of Object.entries(attributes)) part.setAttribute(key, value);
    part.setAttribute("class", className);
    this.svg.append(part);
  }

  run(run, x, y) {
    const at = (p, value) => `${x(p).toFixed(1)},${y(value).toFixed(1)}`;
    if (run.some((p) => p.sd)) {
      const over = run.map((p) => at(p, p.value + 2 * (p.sd || 0)));
      const under = run.map((p) => at(p, p.value - 2 * (p.sd || 0))).reverse();
      this.add("polygon", { points: over.concat(under).join(" ") }, "band");
    }
    this.add("polyline", { points: run.map((p) => at(p, p.value)).join(" ") }, "curve");
  }

  limits(points, x, y) {
    const known = points.filter((p) => p.limit !== null && p.limit !== undefined);
    if (known.length === 0) return;
    const line = known.map((p) => `${x(p).toFixed(1)},${y(p.limit).toFixed(1)}`);
    this.add("polyline", { points: line.join(" ") }, "limit");
  }

  shade(points, x) {
    for (let i = 0; i < points.length; i += 1) {
      if (!points[i].alarm) continue;
      const end = i + 1 < points.length ? x(points[i + 1]) : WIDTH;
      const width = Math.max(end - x(points[i]), 1).toFixed(1);
      this.add("rect", { x: x(points[i]).toFixed(1), y: 0, width, height: HEIGHT }, "shade");
    }
  }

  say(points, low, high) {
    const last = points[points.length - 1];
    const sd = last.sd ? ` ± ${short(2 * last.sd)}` : "";
    const limit = last.limit === null || last.limit === undefined ? "" : ` of ${short(last.limit)}`;
    this.output.textContent = short(last.value) + sd + limit;
    this.range.textContent = `from ${short(low)} to ${short(high)}`;
    const seconds = last.time - points[0].time;
    this.span.textContent = seconds > 0 ? `last ${short(seconds)} s` : "";
    this.svg.setAttribute("aria-label", `${this.name}: ${this.output.textContent}`);
  }
}

function padded(low, high) {
  const pad = high > low ? 0.06 * (high - low) : Math.max(Math.abs(high), 1) * 0.5;
  return [low - pad, high + pad];
}

/* The stretches in which there is a value. */
function runs(points) {
  const found = [];
  let run = [];
  for (const p of points) {
    if (p.value === null) {
      if (run.length) found.push(run);
      run = [];
    } else run.push(p);
  }
  if (run.length) found.push(run);
  return found;
}
