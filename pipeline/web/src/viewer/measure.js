// Distances and heights between two clicked points: lines in the scene, labels over it.

import { BufferGeometry, Group, LineBasicMaterial, LineDashedMaterial, LineSegments, Vector3 } from "three";

const LABEL_ABOVE_PX = 22; // so that a label does not hide a short line

export class Measuring {
  /** @param {HTMLElement} layer Holds the labels. @param {{metres: boolean}} facts */
  constructor(layer, facts, changed) {
    this.layer = layer;
    this.facts = facts;
    this.changed = changed;
    this.group = new Group();
    this.kind = null; // "distance", "height" or null
    this.first = null;
    this.results = [];
    this.dot = this.label("dot");
  }

  /** Begin with a tool, or end with null. */
  use(kind) {
    this.kind = kind;
    this.first = null;
    this.changed();
  }

  label(name) {
    const element = document.createElement("div");
    element.className = name;
    element.hidden = true;
    this.layer.append(element);
    return element;
  }

  /** A clicked point: the first, or the second, which makes a measurement. */
  click(point) {
    if (!this.first) {
      this.first = point;
      this.changed();
      return null;
    }
    const result = this.add(this.kind, this.first, point);
    this.first = null;
    return result;
  }

  /** @returns {{kind, distance, horizontal, height, from, to}} In world units. */
  add(kind, from, to) {
    const height = to.z - from.z;
    const horizontal = Math.hypot(to.x - from.x, to.y - from.y);
    const result = { kind, from, to, distance: from.distanceTo(to), horizontal, height };
    const corner = new Vector3(to.x, to.y, from.z);
    const solid = kind === "height" ? [corner, to] : [from, to];
    const dashed = kind === "height" ? [from, corner] : [];
    const lines = [this.line(solid, false), ...(dashed.length ? [this.line(dashed, true)] : [])];
    const label = this.label("measured");
    label.textContent = kind === "height" ? `Δh ${this.told(height, true)}` : this.told(result.distance);
    label.title = `Length ${this.told(result.distance)}, horizontal ${this.told(horizontal)}, height ${this.told(height, true)}`;
    const ends = [this.label("dot"), this.label("dot")];
    this.results.push({ result, lines, label, ends, middle: new Vector3().addVectors(solid[0], solid[1]).multiplyScalar(0.5) });
    this.changed();
    return result;
  }

  line(points, dashed) {
    const Material = dashed ? LineDashedMaterial : LineBasicMaterial;
    const line = new LineSegments(
      new BufferGeometry().setFromPoints(points),
      new Material({ color: 0xffffff, depthTest: false, transparent: true, ...(dashed ? { dashSize: points[0].distanceTo(points[1]) / 21, gapSize: points[0].distanceTo(points[1]) / 42 } : {}) }),
    );
    if (dashed) line.computeLineDistances();
    line.renderOrder = 2;
    line.frustumCulled = false;
    this.group.add(line);
    return line;
  }

  told(length, signed = false) {
    const sign = signed && length > 0 ? "+" : "";
    if (!this.facts.metres) return `${sign}${length.toPrecision(4)} units`;
    return `${sign}${length.toFixed(Math.abs(length) < 1 ? 3 : 2)} m`;
  }

  undo() {
    if (this.first) this.first = null;
    else if (this.results.length) this.remove(this.results.pop());
    this.changed();
  }

  clear() {
    this.first = null;
    while (this.results.length) this.remove(this.results.pop());
    this.changed();
  }

  remove({ lines, label, ends }) {
    for (const line of lines) {
      this.group.remove(line);
      line.geometry.dispose();
      line.material.dispose();
    }
    for (const element of [label, ...ends]) element.remove();
  }

  /** Move the labels to where their points are in the window. */
  update(view) {
    const put = (element, point, above = 0) => {
      const { x, y, depth } = view.project(point);
      element.hidden = depth <= 0;
      element.style.transform = `translate(${x.toFixed(1)}px, ${(y - above).toFixed(1)}px) translate(-50%, -50%)`;
    };
    this.dot.hidden = !this.first;
    if (this.first) put(this.dot, this.first);
    for (const { result, label, ends, middle } of this.results) {
      put(label, middle, LABEL_ABOVE_PX);
      put(ends[0], result.from);
      put(ends[1], result.to);
    }
  }

  /** Draw the labels into a picture. */
  draw(canvas, scale) {
    const context = canvas.getContext("2d");
    context.font = `600 ${13 * scale}px system-ui, sans-serif`;
    context.textAlign = "center";
    context.textBaseline = "middle";
    for (const element of this.layer.querySelectorAll(".measured:not([hidden])")) {
      const box = element.getBoundingClientRect();
      const [x, y] = [(box.left + box.width / 2) * scale, (box.top + box.height / 2) * scale];
      context.fillStyle = "rgba(15, 20, 26, 0.85)";
      context.fillRect(box.left * scale, box.top * scale, box.width * scale, box.height * scale);
      context.fillStyle = "#fff";
      context.fillText(element.textContent, x, y);
    }
  }
}
