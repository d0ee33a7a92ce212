// Measurements on the surface model: sections and volumes as a list and as lines in 3D, and a section as a chart.
// measured_viewer.py puts them into the page.

import { Vector3 } from "three";
import { Chart } from "./chart.js";
import { placesOf, Traces } from "./traces.js";

const SECTION_PITCH_RAD = -0.45; // sections are viewed from the side, volumes more from above
const VOLUME_PITCH_RAD = -0.9;
const NARROW = "(max-width: 640px), (max-height: 520px)"; // as in viewer.css: the list is collapsed there

const $ = (id) => document.getElementById(id);

/** Format a value with its standard deviation, rounded to the latter's first two digits. */
function withSigma(value, sigma) {
  const digits = sigma > 0 ? Math.min(3, Math.max(0, 1 - Math.floor(Math.log10(sigma)))) : 1;
  return `${value.toFixed(digits)} ± ${sigma.toFixed(digits)}`;
}

function length(metres) {
  return metres < 0.1 ? `${(100 * metres).toFixed(1)} cm` : `${metres.toFixed(2)} m`;
}

function sectionLines({ length_m, share_with_height, height_sigma_m }) {
  const known = share_with_height < 0.995 ? ` · ${(100 * share_with_height).toFixed(0)} % with heights` : "";
  return [`${length_m.toFixed(2)} m long${known}`, ...(height_sigma_m === null ? [] : [`heights ± ${length(height_sigma_m)}`])];
}

function volumeLines(facts) {
  const volume = (kind) => `${withSigma(facts[`${kind}_m3`], facts[`${kind}_sigma_m3`])} m³`;
  const base = { rim: "the plane through the rim", lowest: "the lowest point of the rim", stated: "a stated height", ground: "the ground" }[facts.base];
  const over = `${facts.area_m2.toFixed(1)} m²${facts.model === "dtm" ? " of ground" : ""}, over ${base ?? "a base"}`;
  return [`net ${volume("net")}`, `cut ${volume("cut")}, fill ${volume("fill")}`, over];
}

/** The part of the window not covered by the list and the photos, CSS pixels. */
function freeWindow() {
  const [list, photos, tools] = ["results", "bottom", "tools"].map((id) => $(id).getBoundingClientRect());
  const aside = list.right < innerWidth / 2;
  const [left, top] = aside ? [list.right, 0] : [0, list.bottom];
  const right = aside ? tools.left : innerWidth;
  return { x: (left + right) / 2, y: (top + photos.top) / 2, width: right - left, height: Math.max(1, photos.top - top) };
}

export class Results {
  /**
   * @param {{sections: object[], volumes: object[]}} measured
   * @param {{changed: () => void, look: (places: Vector3[], forward: Vector3 | null, pitch: number,
   *   free: object) => void}} viewer
   */
  constructor(measured, viewer) {
    this.viewer = viewer;
    this.items = [
      ...measured.sections.map((facts) => ({ kind: "section", ...facts, lines: sectionLines(facts), traces: [facts.trace] })),
      ...measured.volumes.map((facts) => ({ kind: "volume", ...facts, lines: volumeLines(facts), traces: facts.trace })),
    ].filter(({ traces }) => placesOf(traces).length > 1);
    this.traces = new Traces($("labels"), this.items, viewer.changed);
    this.chart = new Chart($("chart"), (index) => this.point(index));
    this.buttons = this.items.map((item, index) => this.button(item, index));
    this.chosen = null;
    $("fold").addEventListener("click", () => this.unfold($("fold").getAttribute("aria-expanded") !== "true"));
    $("fold").textContent = this.title();
    this.show(this.items.length > 0);
    $("results_button").hidden = !this.items.length;
    this.unfold(!matchMedia(NARROW).matches);
  }

  title() {
    const count = (kind) => this.items.filter((item) => item.kind === kind).length;
    const counted = (number, one) => (number ? [`${number} ${one}${number === 1 ? "" : "s"}`] : []);
    return [...counted(count("section"), "section"), ...counted(count("volume"), "volume")].join(", ");
  }

  button({ kind, name, lines }, index) {
    const button = document.createElement("button");
    button.type = "button";
    button.className = kind;
    const title = document.createElement("b");
    title.textContent = name;
    const rest = lines.map((text) => Object.assign(document.createElement("span"), { textContent: text }));
    button.append(title, ...rest);
    button.addEventListener("click", () => this.choose(index === this.chosen ? null : index));
    const item = document.createElement("li");
    item.append(button);
    $("results_list").append(item);
    return { button, item };
  }

  /** Go to an item and show its chart, if any; null clears the selection. */
  choose(index) {
    this.chosen = index;
    this.traces.choose(index);
    this.traces.point(null);
    this.buttons.forEach(({ button }, i) => button.setAttribute("aria-pressed", String(i === index)));
    const found = index === null ? null : this.items[index];
    $("profile").hidden = found?.kind !== "section";
    if (!found) return;
    if (found.kind === "section") {
      this.buttons[index].item.append($("profile"));
      this.chart.show(found.trace);
    }
    const places = placesOf(found.traces);
    const [start, end] = [places[0], places.at(-1)];
    const aside = found.kind === "section" ? new Vector3(start.y - end.y, end.x - start.x, 0) : null; // start on the left
    this.viewer.look(places, aside, aside ? SECTION_PITCH_RAD : VOLUME_PITCH_RAD, freeWindow());
    this.buttons[index].item.scrollIntoView({ block: "nearest" });
  }

  /** Show the values at a place of the chosen section. */
  point(index) {
    const trace = this.items[this.chosen]?.trace;
    const reading = $("reading");
    if (index === null || !trace) {
      reading.textContent = `Metres; heights ${this.chart.enlarged.toFixed(1)} times exaggerated. Point at the chart to read values.`;
      this.traces.point(null);
      return;
    }
    const [height, sigma] = [trace.height[index], trace.sigma[index]];
    const heightText = height === null ? "no height here" : `height ${height.toFixed(2)} m${sigma === null ? "" : ` ± ${length(sigma)}`}`;
    const ground = trace.ground?.[index] ?? null;
    const overText = height === null || ground === null ? "" : `, ${Math.max(0, height - ground).toFixed(2)} m over the ground`;
    reading.textContent = `${trace.distance[index].toFixed(2)} m: ${heightText}${overText}`;
    this.traces.point(height === null ? null : new Vector3(trace.x[index], trace.y[index], trace.z[index]));
  }

  unfold(open) {
    $("fold").setAttribute("aria-expanded", String(open));
    $("results_list").hidden = !open;
  }

  get shown() {
    return this.traces.group.visible;
  }

  /** Show or hide the lines and the list. */
  show(shown) {
    if (!this.items.length) return;
    this.traces.show(shown);
    $("results").hidden = !shown;
    $("results_button").setAttribute("aria-pressed", String(shown));
  }
}
