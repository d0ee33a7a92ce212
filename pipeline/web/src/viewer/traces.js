// Lines of sections and volumes over the model, with labels.

import { Group, Vector3 } from "three";
import { LineMaterial } from "three/examples/jsm/lines/LineMaterial.js";
import { LineSegments2 } from "three/examples/jsm/lines/LineSegments2.js";
import { LineSegmentsGeometry } from "three/examples/jsm/lines/LineSegmentsGeometry.js";

const COLOURS = { section: 0x4dd6ff, volume: 0xffd23f };
const HALO = { colour: 0x0a0e12, more: 3, opacity: 0.6 };
const WIDTH = { plain: 2, chosen: 4 }; // CSS pixels
const MAX_NAMES = 12; // with more, only the chosen one is labelled
const NAME_ABOVE_PX = 16;

/** A trace's points as line segments, without those across gaps. */
function segments({ x, y, z }) {
  const found = [];
  for (let i = 1; i < z.length; i++) {
    if (z[i - 1] !== null && z[i] !== null) found.push(x[i - 1], y[i - 1], z[i - 1], x[i], y[i], z[i]);
  }
  return found;
}

export function placesOf(traces) {
  return traces.flatMap(({ x, y, z }) => z.map((up, i) => (up === null ? null : new Vector3(x[i], y[i], up))).filter(Boolean));
}

export class Traces {
  /**
   * @param {HTMLElement} layer Holds the names.
   * @param {{kind: string, name: string, traces: object[]}[]} items
   * @param {() => void} changed
   */
  constructor(layer, items, changed) {
    Object.assign(this, { layer, changed, chosen: null });
    this.group = new Group();
    this.items = items.map((item) => this.make(item));
    this.dot = this.label("dot", "");
    this.here = null;
    this.choose(null);
  }

  make({ kind, name, traces }) {
    const places = traces.flatMap(segments);
    const geometry = new LineSegmentsGeometry().setPositions(places);
    const line = (color, opacity, order) => {
      const material = new LineMaterial({ color, opacity, transparent: true, depthTest: false, depthWrite: false });
      const made = new LineSegments2(geometry, material);
      made.frustumCulled = false;
      made.renderOrder = order;
      this.group.add(made);
      return made;
    };
    const lines = { halo: line(HALO.colour, HALO.opacity, 2), line: line(COLOURS[kind], 1, 3) };
    const at = placesOf(traces);
    const named = kind === "section" ? at[0] : at.reduce((a, b) => (b.z > a.z ? b : a)); // a section is labelled at its start
    return { ...lines, named, label: this.label("named", name) };
  }

  label(className, text) {
    const element = document.createElement("div");
    element.className = className;
    element.textContent = text;
    element.hidden = true;
    this.layer.append(element);
    return element;
  }

  /** Highlight one; null for none. */
  choose(index) {
    this.chosen = index;
    this.items.forEach(({ halo, line }, i) => {
      const width = i === index ? WIDTH.chosen : WIDTH.plain;
      line.material.linewidth = width;
      halo.material.linewidth = width + HALO.more;
    });
    this.changed();
  }

  /** Put a dot at a place; null removes it. */
  point(place) {
    this.here = place;
    if (this.view) this.update(this.view);
  }

  show(shown) {
    this.group.visible = shown;
    this.changed();
  }

  /** Move labels and the dot to their window positions. */
  update(view) {
    this.view = view;
    const put = (element, place, above) => {
      const at = this.group.visible && place ? view.project(place) : { depth: 0 };
      element.hidden = at.depth <= 0;
      if (at.depth > 0) element.style.transform = `translate(${at.x.toFixed(1)}px, ${(at.y - above).toFixed(1)}px) translate(-50%, -50%)`;
    };
    const few = this.items.length <= MAX_NAMES;
    this.items.forEach(({ label, named }, i) => put(label, few || i === this.chosen ? named : null, NAME_ABOVE_PX));
    put(this.dot, this.here, 0);
  }
}
