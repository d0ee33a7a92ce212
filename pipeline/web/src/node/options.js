// The form of a run's options: preset and CRS as a surveyor chooses them, the node's other options below.

import { element } from "../mark/panels.js";
import { roughly, size } from "./words.js";

const PRESETS = {
  preview: "A quick look, to see whether the capture is complete.",
  standard: "For most work: all products.",
  high: "The most detail; takes several times as long.",
};
// The other options in words; their names are OpenDroneMap's.
const LABELS = {
  dsm: "Surface model (DSM)",
  dtm: "Terrain model (DTM)",
  "orthophoto-resolution": "Pixel size of the orthophoto, cm",
  "dem-resolution": "Cell size of DSM and DTM, cm",
  "fast-orthophoto": "Orthophoto only, without a splat",
  "pc-quality": "Quality of depths",
  "feature-quality": "Quality of keypoints",
  mesh: "Textured mesh",
  "mesh-size": "Most triangles of the mesh",
  facades: "Façades",
  boundary: "Boundary (GeoJSON)",
  vertical: "Vertical datum",
  "check-points": "Check points",
  "time-budget": "Time budget",
  sky: "Sky",
};
const FEATURED = ["preset", "crs"];
const CRS_FORM = "(EPSG:\\s*)?\\d{3,6}(\\+\\d{3,6})?|\\+proj=.+|WGS84 UTM \\d{1,2}[NSns]|[Gg][Cc][Pp]|auto";
let forms = 0;

export class OptionsForm {
  /** `offered` are the node's options as WebODM gets them; `chosen` those of a run to repeat. */
  constructor(offered, chosen = []) {
    this.offered = offered;
    this.chosen = new Map(chosen.map(({ name, value }) => [name, value]));
    this.id = `form${(forms += 1)}`;
    this.root = element("div", { class: "options" });
    this.fields = new Map(); // option's name and how to read it
    this.forecasts = new Map();
    this.#build();
  }

  /** What differs from the node's defaults, as the API takes it. */
  values() {
    const values = [];
    for (const [name, read] of this.fields) {
      const value = read();
      if (value !== null) values.push({ name, value });
    }
    return values;
  }

  /** Show the forecast of each preset, as `check` states it. */
  forecast(forecasts) {
    for (const each of forecasts ?? []) {
      const place = this.forecasts.get(each.preset);
      if (!place) continue;
      place.replaceChildren(`${roughly(each.seconds)}, ${size(each.memory_bytes)} of memory, ${size(each.disk_bytes)} of disk`);
      if (each.lacking) place.append(element("strong", { class: "lacking" }, ` It needs ${each.lacking}.`));
    }
  }

  /** The first field that cannot be sent as it is; null if all can. */
  get wrong() {
    return this.root.querySelector(":invalid:not(fieldset)");
  }

  #build() {
    const offered = new Map(this.offered.map((option) => [option.name, option]));
    if (offered.has("preset")) this.root.append(this.#presets(offered.get("preset")));
    if (offered.has("crs")) this.root.append(this.#crs(offered.get("crs")));
    const more = element("details", { class: "more" }, element("summary", {}, "More options"));
    for (const option of this.offered) if (!FEATURED.includes(option.name)) more.append(this.#field(option));
    if (more.children.length > 1) this.root.append(more);
  }

  #presets(option) {
    const set = element("fieldset", { class: "presets" }, element("legend", {}, "Preset"));
    const chosen = this.chosen.get("preset") ?? option.value;
    for (const name of option.domain) {
      const input = element("input", { type: "radio", name: `${this.id}-preset`, value: name });
      input.checked = name === chosen;
      const forecast = element("span", { class: "forecast" });
      this.forecasts.set(name, forecast);
      set.append(element("label", {}, input, element("b", {}, name), element("span", {}, PRESETS[name] ?? ""), forecast));
    }
    this.fields.set("preset", () => set.querySelector(":checked")?.value ?? null);
    return set;
  }

  #crs(option) {
    const input = element("input", {
      type: "text", id: `${this.id}-crs`, spellcheck: "false", autocapitalize: "off", placeholder: "automatic",
      pattern: CRS_FORM, "aria-describedby": `${this.id}-crs-help`, value: this.chosen.get("crs") ?? "",
    });
    this.fields.set("crs", () => input.value.trim() || null);
    const help = "For example EPSG:25833. Automatic: that of your control points, else the UTM zone of the photos.";
    return element("div", { class: "field" },
      element("label", { for: input.id }, "Coordinate system of the results"), input,
      element("p", { class: "small", id: `${this.id}-crs-help`, title: option.help }, help));
  }

  #field(option) {
    const id = `${this.id}-${option.name}`;
    const value = this.chosen.get(option.name);
    const help = element("p", { class: "small", id: `${id}-help` }, option.help.split(/ (?:Can be one of|Default): /)[0]);
    const label = element("label", { for: id }, LABELS[option.name] ?? option.name.replaceAll("-", " "));
    const described = { id, "aria-describedby": `${id}-help` };
    if (option.type === "bool") {
      const input = element("input", { type: "checkbox", ...described });
      input.checked = value === true;
      this.fields.set(option.name, () => (input.checked ? true : null));
      return element("div", { class: "field check" }, input, label, help);
    }
    if (option.type === "enum") {
      const input = element("select", described, ...option.domain.map((name) => element("option", { value: name }, name)));
      input.value = value ?? option.value;
      this.fields.set(option.name, () => (input.value === option.value ? null : input.value));
      return element("div", { class: "field" }, label, input, help);
    }
    const number = option.type === "int" || option.type === "float";
    const input = element("input", { type: number ? "number" : "text", ...described, placeholder: option.value, value: value ?? "" });
    if (number) input.step = option.type === "int" ? "1" : "any";
    this.fields.set(option.name, () => (input.value.trim() === "" ? null : number ? Number(input.value) : input.value.trim()));
    return element("div", { class: "field" }, label, input, help);
  }
}
