// The mesh and the dense points that are shown instead of the splat, if the run made them: from the page, or on a site
// from a file beside it, which is requested when first shown.

import { BufferAttribute, BufferGeometry, DoubleSide, Mesh, MeshBasicMaterial, Raycaster, SRGBColorSpace, Texture } from "three";
import { LoadError } from "./error.js";
import { fetchBytes } from "./files.js";
import { bytesOf } from "./page.js";
import { fillPoints, makePoints, nearestPoint } from "./points.js";

const LAYERS = ["mesh", "points"];
const UV_STEPS = 65535;

/** Numbers of another type in the bytes of base64 text. */
async function numbers(text, Type) {
  const bytes = await bytesOf(text);
  return new Type(bytes.buffer, bytes.byteOffset, bytes.byteLength / Type.BYTES_PER_ELEMENT);
}

/** Places in the world about their lowest corner: whole steps from it. */
async function places({ step, xyz }) {
  return Float32Array.from(await numbers(xyz, Uint16Array), (steps) => steps * step);
}

async function makeMesh(data) {
  const geometry = new BufferGeometry();
  geometry.setAttribute("position", new BufferAttribute(await places(data), 3));
  geometry.setAttribute("uv", new BufferAttribute(Float32Array.from(await numbers(data.uv, Uint16Array), (steps) => steps / UV_STEPS), 2));
  geometry.setIndex(new BufferAttribute(await numbers(data.indices, Uint32Array), 1));
  const image = new Image();
  image.src = data.texture;
  await image.decode();
  const map = new Texture(image);
  Object.assign(map, { flipY: false, colorSpace: SRGBColorSpace, anisotropy: 4, needsUpdate: true });
  return new Mesh(geometry, new MeshBasicMaterial({ map, side: DoubleSide }));
}

async function makeCloud(data) {
  const cloud = makePoints(data.spacing);
  fillPoints(cloud, { xyz: await places(data), rgb: await bytesOf(data.rgb) });
  return cloud;
}

export class Surfaces {
  /** @param {{layers: string[], address?: string, mesh?: object, points?: object}} found What the page has of them. */
  constructor(found) {
    this.found = found;
    this.layers = LAYERS.filter((layer) => found.layers.includes(layer));
    this.loading = {};
    this.objects = {};
    this.caster = new Raycaster();
  }

  /** A layer's object for the scene, made when first asked for. */
  load(layer) {
    this.loading[layer] ??= this.make(layer);
    this.loading[layer].catch(() => delete this.loading[layer]); // to be tried again
    return this.loading[layer];
  }

  async make(layer) {
    this.data ??= await this.read();
    const data = this.data[layer];
    if (!data) throw new LoadError("The surfaces do not fit this page.", "Copy its folder again.");
    const object = await (layer === "mesh" ? makeMesh : makeCloud)(data);
    object.position.fromArray(data.low);
    object.updateMatrixWorld();
    delete this.data[layer]; // the GPU has it
    this.objects[layer] = object;
    return object;
  }

  async read() {
    if (!this.found.address) return this.found;
    return JSON.parse(new TextDecoder().decode(await fetchBytes(this.found.address)));
  }

  /** The place of a layer at a window position, or null. */
  pick(layer, view, x, y) {
    const object = this.objects[layer];
    if (!object) return null;
    if (layer === "points") return nearestPoint(object, view, x, y);
    this.caster.set(view.position, view.ray(x, y));
    return this.caster.intersectObject(object)[0]?.point ?? null;
  }
}
