// Distances and heights between two clicked points: lines and labels over the image.

import { Vector3 } from "three";

const LABEL_ABOVE_PX = 20; // so that a label does not hide a short line
const HALO = { width: 4.5, colour: "rgba(10, 14, 18, 0.7)" };
const LINE = { width: 2, colour: "#ffffff" };
const DASHES = [7, 5];

export class Measuring {
  /** @param {HTMLElement} layer Holds the labels. @param {SVGElement} drawing Holds the lines. @param {{metres: boolean}} facts */
  constructor(layer, drawing, facts, changed) {
    Object.assign(this, { layer, drawing, facts, changed });
    this.kind = null; // "distance", "height" or null
    this.first = null;
    this.results = [];
    this.segments = []; // on the screen: [x, y, x, y, dashed]
    this.dot = this.label("dot");
    this.rubber = null; // from the first point to the cursor
  }

  /** Start a tool, or stop with null. */
  use(kind) {
    this.kind = kind;
    this.first = null;
    this.hover(null);
    this.changed();
  }

  label(name) {
    const element = document.createElement("div");
    element.className = name;
    element.hidden = true;
    this.layer.append(element);
    return element;
  }

  /** Handle a clicked point: the first, or the second, which completes a measurement. */
  click(point) {
    this.hover(null);
    if (!this.first) {
      this.first = point;
      this.changed();
      return null;
    }
    const result = this.add(this.kind, this.first, point);
    this.first = null;
    return result;
  }

  /** Handle the point under the cursor, or null: shows what a click would measure. */
  hover(point) {
    if (this.rubber) this.remove(this.rubber);
    this.rubber = this.first && point ? this.make(this.kind, this.first, point) : null;
    this.show();
  }

  /** @returns {{kind, distance, horizontal, height, from, to}} In world units. */
  add(kind, from, to) {
    const made = this.make(kind, from, to);
    this.results.push(made);
    this.changed();
    return made.result;
  }

  make(kind, from, to) {
    const height = to.z - from.z;
    const horizontal = Math.hypot(to.x - from.x, to.y - from.y);
    const result = { kind, from, to, distance: from.distanceTo(to), horizontal, height };
    const corner = new Vector3(to.x, to.y, from.z);
    const lines = kind === "height" ? [[corner, to, false], [from, corner, true]] : [[from, to, false]];
    const label = this.label("measured");
    label.textContent = kind === "height" ? `Δh ${this.formatLength(height, true)}` : this.formatLength(result.distance);
    const middle = new Vector3().addVectors(lines[0][0], lines[0][1]).multiplyScalar(0.5);
    return { result, lines, label, ends: [this.label("dot"), this.label("dot")], middle };
  }

  formatLength(length, signed = false) {
    const sign = signed && length > 0 ? "+" : "";
    if (!this.facts.metres) return `${sign}${length.toPrecision(4)} units`;
    return `${sign}${length.toFixed(Math.abs(length) < 1 ? 3 : 2)} m`;
  }

  undo() {
    if (this.first) this.first = null;
    else if (this.results.length) this.remove(this.results.pop());
    this.hover(null);
    this.changed();
  }

  remove({ label, ends }) {
    for (const element of [label, ...ends]) element.remove();
  }

  /** Move everything to its points' window positions. */
  update(view) {
    this.view = view;
    this.show();
  }

  show() {
    const { view } = this;
    if (!view) return;
    const put = (element, point, above = 0) => {
      const { x, y, depth } = view.project(point);
      element.hidden = depth <= 0;
      element.style.transform = `translate(${x.toFixed(1)}px, ${(y - above).toFixed(1)}px) translate(-50%, -50%)`;
    };
    this.dot.hidden = !this.first;
    if (this.first) put(this.dot, this.first);
    this.segments = [];
    for (const { result, lines, label, ends, middle } of this.rubber ? [...this.results, this.rubber] : this.results) {
      put(label, middle, LABEL_ABOVE_PX);
      put(ends[0], result.from);
      put(ends[1], result.to);
      for (const [a, b, dashed] of lines) {
        const segment = onScreen(view, a, b);
        if (segment) this.segments.push([...segment, dashed]);
      }
    }
    this.drawing.replaceChildren(...this.segments.flatMap((segment) => [svgLine(segment, HALO), svgLine(segment, LINE)]));
  }

  /** Draw all measurements into an image. */
  draw(canvas, scale) {
    const context = canvas.getContext("2d");
    context.scale(scale, scale);
    for (const style of [HALO, LINE]) {
      context.strokeStyle = style.colour;
      context.lineWidth = style.width;
      for (const [ax, ay, bx, by, dashed] of this.segments) {
        context.setLineDash(dashed ? DASHES : []);
        context.beginPath();
        context.moveTo(ax, ay);
        context.lineTo(bx, by);
        context.stroke();
      }
    }
    context.font = "600 13px system-ui, sans-serif";
    context.textAlign = "center";
    context.textBaseline = "middle";
    for (const element of this.layer.querySelectorAll(".measured:not([hidden]), .named:not([hidden])")) {
      const box = element.getBoundingClientRect();
      context.fillStyle = "rgba(15, 20, 26, 0.85)";
      context.fillRect(box.left, box.top, box.width, box.height);
      context.fillStyle = "#fff";
      context.fillText(element.textContent, box.left + box.width / 2, box.top + box.height / 2, box.width);
    }
  }
}

/** A world segment on the screen, clipped at the near plane; null if all of it is behind. */
function onScreen(view, a, b) {
  const { near } = view.planes;
  const [pa, pb] = [view.project(a), view.project(b)];
  if (pa.depth < near && pb.depth < near) return null;
  const cut = (from, to, share) => view.project(new Vector3().lerpVectors(from, to, share));
  const start = pa.depth < near ? cut(a, b, (near - pa.depth) / (pb.depth - pa.depth)) : pa;
  const end = pb.depth < near ? cut(a, b, (near - pa.depth) / (pb.depth - pa.depth)) : pb;
  return [start.x, start.y, end.x, end.y];
}

function svgLine([ax, ay, bx, by, dashed], { width, colour }) {
  const line = document.createElementNS("http://www.w3.org/2000/svg", "line");
  const values = { x1: ax, y1: ay, x2: bx, y2: by, stroke: colour, "stroke-width": width, "stroke-linecap": "round" };
  if (dashed) values["stroke-dasharray"] = DASHES.join(" ");
  for (const [name, value] of Object.entries(values)) line.setAttribute(name, value);
  return line;
}
