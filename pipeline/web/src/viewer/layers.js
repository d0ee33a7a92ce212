// The switch between the splat, the mesh and the dense points. Without mesh and points there is no switch.

import { Surfaces } from "./surfaces.js";

const LAYERS = ["splat", "mesh", "points"];

const $ = (id) => document.getElementById(id);

export class Layers {
  /**
   * @param {object | null} found What the page has of mesh and points, see surfaces.js; null for nothing.
   * @param {{add: (object: object) => void, changed: () => void, failed: (error: Error) => void}} viewer
   */
  constructor(found, viewer) {
    this.viewer = viewer;
    this.surfaces = found && new Surfaces(found);
    this.shown = "splat"; // or what is going to be, while sparse points hide it
    for (const element of [$("layers"), ...document.querySelectorAll(".for-layers")]) element.hidden = !found;
    for (const layer of this.surfaces?.layers ?? []) this.button(layer).hidden = false;
    const choose = (layer) => () => this.show(layer).catch((error) => viewer.failed(error));
    this.actions = Object.fromEntries(LAYERS.map((layer) => [`${layer}_layer`, choose(layer)]));
  }

  button(layer) {
    return $(`${layer}_layer`);
  }

  /** Show a layer from the same viewpoint; resolves to false if the run did not make it. */
  async show(layer) {
    if (layer !== "splat" && !this.surfaces?.layers.includes(layer)) return false;
    this.wanted = layer;
    if (layer !== "splat" && !this.surfaces.objects[layer]) {
      const object = await this.surfaces.load(layer);
      object.visible = false;
      if (!object.parent) this.viewer.add(object);
    }
    if (this.wanted === layer) { // no other one was chosen meanwhile
      this.shown = layer;
      this.viewer.changed();
    }
    return true;
  }

  /** Hide whatever is shown, or show it again. */
  hide(hidden) {
    for (const layer of LAYERS) {
      const visible = !hidden && layer === this.shown;
      this.button(layer).setAttribute("aria-pressed", String(visible));
      const object = this.surfaces?.objects[layer];
      if (object) object.visible = visible;
    }
  }

  /** The place of the mesh or the points at a window position, or null. */
  pick(view, x, y) {
    return this.surfaces.pick(this.shown, view, x, y);
  }
}
