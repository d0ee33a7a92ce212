// A section as a chart: distance to the right, height up, both in metres; shows the values under the pointer.

const SIZE = { width: 340, height: 176 };
const FRAME = { left: 46, right: 8, top: 8, bottom: 20 };
const STEPS = [1, 2, 5];
const MAX_TICKS = { across: 5, up: 4 };
const MIN_RANGE_M = 0.1; // of heights, so that the noise of a flat floor is not exaggerated

/** A step of 1, 2 or 5 times a power of ten that divides a range into at most `most` parts. */
function stepOf(range, most) {
  for (let power = Math.floor(Math.log10(range / most)); ; power++) {
    const step = STEPS.map((base) => base * 10 ** power).find((each) => range / each <= most);
    if (step) return step;
  }
}

function ticks([low, high], most) {
  const step = stepOf(high - low, most);
  const digits = Math.max(0, -Math.floor(Math.log10(step)));
  const first = Math.ceil(low / step - 1e-9);
  const count = Math.floor(high / step + 1e-9) - first + 1;
  return Array.from({ length: count }, (_, i) => (first + i) * step).map((value) => [value, value.toFixed(digits)]);
}

function svg(name, values, text) {
  const element = document.createElementNS("http://www.w3.org/2000/svg", name);
  for (const [key, value] of Object.entries(values)) element.setAttribute(key, value);
  if (text !== undefined) element.textContent = text;
  return element;
}

export class Chart {
  /**
   * @param {SVGElement} drawing Filled here.
   * @param {(index: number | null) => void} pointed Called with the index of the place under the pointer.
   */
  constructor(drawing, pointed) {
    Object.assign(this, { drawing, pointed, trace: null });
    drawing.setAttribute("viewBox", `0 0 ${SIZE.width} ${SIZE.height}`);
    for (const name of ["pointerdown", "pointermove"]) drawing.addEventListener(name, (event) => this.point(event));
    drawing.addEventListener("pointerleave", () => this.mark(null));
  }

  /** @param {object} trace Columns of a section, see traces.py. */
  show(trace) {
    this.trace = trace;
    const known = [...trace.height, ...(trace.ground ?? []), ...trace.point_height].filter((height) => height !== null);
    const [low, high] = [known.reduce((a, b) => Math.min(a, b)), known.reduce((a, b) => Math.max(a, b))];
    const spare = Math.max(0.06 * (high - low), (MIN_RANGE_M - (high - low)) / 2);
    this.across = [0, trace.distance.at(-1)];
    this.up = [low - spare, high + spare];
    this.cursor = svg("path", { class: "cursor" });
    this.dot = svg("circle", { class: "here", r: 3.5 });
    this.drawing.replaceChildren(
      ...this.grid(),
      svg("path", { class: "seen", d: trace.point_distance.map((at, i) => `M${this.place(at, trace.point_height[i])}h0`).join("") }),
      svg("path", { class: "ground", d: this.profile(trace.ground ?? []) }),
      svg("path", { class: "profile", d: this.profile(trace.height) }),
      this.cursor,
      this.dot,
    );
    this.mark(null);
  }

  /** Vertical exaggeration of the chart. */
  get enlarged() {
    const wide = (SIZE.width - FRAME.left - FRAME.right) / (this.across[1] - this.across[0]);
    return (SIZE.height - FRAME.top - FRAME.bottom) / (this.up[1] - this.up[0]) / wide;
  }

  x(distance) {
    return FRAME.left + (distance / this.across[1]) * (SIZE.width - FRAME.left - FRAME.right);
  }

  y(height) {
    const share = (height - this.up[0]) / (this.up[1] - this.up[0]);
    return SIZE.height - FRAME.bottom - share * (SIZE.height - FRAME.top - FRAME.bottom);
  }

  place(distance, height) {
    return `${this.x(distance).toFixed(1)} ${this.y(height).toFixed(1)}`;
  }

  profile(height) {
    const { distance } = this.trace;
    return height.map((up, i) => (up === null ? "" : `${i && height[i - 1] !== null ? "L" : "M"}${this.place(distance[i], up)}`)).join("");
  }

  grid() {
    const [right, bottom] = [SIZE.width - FRAME.right, SIZE.height - FRAME.bottom];
    const levels = ticks(this.up, MAX_TICKS.up).flatMap(([up, text]) => [
      svg("path", { class: "grid", d: `M${FRAME.left} ${this.y(up)}H${right}` }),
      svg("text", { x: FRAME.left - 5, y: this.y(up) + 3.5, "text-anchor": "end" }, text),
    ]);
    const marks = ticks(this.across, MAX_TICKS.across).flatMap(([at, text]) => [
      svg("path", { class: "grid", d: `M${this.x(at)} ${FRAME.top}V${bottom}` }),
      svg("text", { x: this.x(at), y: SIZE.height - 6, "text-anchor": "middle" }, text),
    ]);
    return [...levels, ...marks];
  }

  point(event) {
    const box = this.drawing.getBoundingClientRect();
    const x = ((event.clientX - box.left) / box.width) * SIZE.width;
    const share = (x - FRAME.left) / (SIZE.width - FRAME.left - FRAME.right);
    const at = Math.min(1, Math.max(0, share)) * this.across[1];
    const { distance } = this.trace;
    const after = distance.findIndex((each) => each >= at);
    this.mark(after > 0 && at - distance[after - 1] < distance[after] - at ? after - 1 : Math.max(0, after));
  }

  mark(index) {
    const height = index === null ? null : this.trace.height[index];
    this.cursor.setAttribute("d", index === null ? "" : `M${this.x(this.trace.distance[index])} ${FRAME.top}V${SIZE.height - FRAME.bottom}`);
    this.dot.setAttribute("visibility", height === null ? "hidden" : "visible");
    if (height !== null) {
      this.dot.setAttribute("cx", this.x(this.trace.distance[index]));
      this.dot.setAttribute("cy", this.y(height));
    }
    this.pointed(index);
  }
}
