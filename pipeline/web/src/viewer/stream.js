// Streams a site's splat: the whole at a coarse level first, then refined where the view is. A node stays until all of
// its children are loaded to replace it, so that there is never a hole.

import { FileQueue } from "./files.js";
import { wantedLevels } from "./levels.js";
import { readPart } from "./part.js";

const PIXELS = 8; // on the screen: smaller errors are not refined; Gaussians are then half a pixel off
const NARROW = "(max-width: 640px), (max-height: 520px), (pointer: coarse)";
const MAX_GAUSSIANS = { wide: 3_000_000, narrow: 800_000 }; // Gaussians in view that a computer and a phone can draw smoothly
const HELD = 1.5; // times as many are in memory at most, including those out of sight: 200 bytes each
const LITTLE_MEMORY_GB = 4; // with less memory, the phone's limits apply
const AT_ONCE = { wide: 4, narrow: 2 }; // files: each is decoded by a worker with its own memory

function size() {
  const small = matchMedia(NARROW).matches || (navigator.deviceMemory ?? Infinity) < LITTLE_MEMORY_GB;
  return small ? "narrow" : "wide";
}

export class LevelStream {
  /**
   * @param {object[]} nodes As returned by `readLevels`.
   * @param {import("./stage.js").Stage} stage
   * @param {(error: Error) => void} failed Called for the first file that cannot be loaded.
   */
  constructor(nodes, stage, failed) {
    this.root = nodes[0];
    this.nodes = nodes;
    this.byFile = new Map(nodes.map((node) => [node.file, node]));
    this.stage = stage;
    this.failed = failed;
    this.limit(MAX_GAUSSIANS[size()]);
    this.refined = new Set();
    this.shown = [];
    this.loaded = 0; // Gaussians
    this.time = 0; // counts the views
    this.waiting = [];
    this.queue = new FileQueue(AT_ONCE[size()], (...file) => this.take(...file), (...file) => this.miss(...file));
    addEventListener("online", () => this.retry());
  }

  /** Set the limits of Gaussians in view and, in proportion, in memory. */
  limit(most) {
    this.most = most;
    this.held = HELD * most;
    this.stage.invalidate();
  }

  /** Load and show the root: the whole model, coarse. */
  async begin(bytes) {
    await this.take(this.root.file, bytes);
    this.shown = [this.root];
    this.stage.show([this.root.part]);
  }

  /** Request the nodes for a view, and show those that are loaded. */
  update(view) {
    this.time++;
    const ratio = this.stage.fullRatio;
    const { most, held, refined } = this;
    const { inner, order } = wantedLevels(this.root, view, { pixels: PIXELS, most, held, ratio, refined });
    const shown = this.cover(this.root, inner);
    this.refined = new Set();
    for (const node of shown) {
      for (let above = node.parent; above && !this.refined.has(above); above = above.parent) this.refined.add(above);
    }
    if (shown.length !== this.shown.length || shown.some((node, i) => node !== this.shown[i])) {
      this.shown = shown;
      this.stage.show(this.parts());
    }
    const useful = order.filter((node) => !this.refined.has(node)); // the others' descendants are shown
    if (shown.reduce((sum, node) => sum + node.count, 0) > held) useful.push(...this.lost(this.root, inner));
    for (const node of [...shown, ...useful]) node.touched = this.time;
    this.queue.want(useful.filter((node) => !node.part && !node.failed).map((node) => node.file));
    this.unload();
    this.settle();
  }

  /** Loaded nodes that together cover a node, as close to the wanted level as possible; null if there are none. */
  cover(node, inner) {
    if (node.part && !inner.has(node)) return [node];
    const parts = [];
    for (const child of node.children) {
      const part = this.cover(child, inner);
      if (!part) return node.part ? [node] : null;
      parts.push(...part);
    }
    return parts.length ? parts : null;
  }

  /** Nodes that were unloaded while their descendants, now finer than wanted, were shown. */
  lost(node, inner) {
    if (!inner.has(node)) return node.part ? [] : [node];
    return node.children.flatMap((child) => this.lost(child, inner));
  }

  async take(file, bytes, signal) {
    const node = this.byFile.get(file);
    const part = await readPart(bytes, node.origin);
    if (signal?.aborted || node.part) return part.dispose();
    node.part = part;
    this.loaded += part.count;
    this.stage.invalidate();
  }

  miss(file, error) {
    this.byFile.get(file).failed = true;
    if (!this.failureShown) this.failed(error);
    this.failureShown = true;
    this.stage.invalidate();
  }

  /** Retry after the network is back. */
  retry() {
    for (const node of this.nodes) node.failed = false;
    this.stage.invalidate();
  }

  /** Unload the nodes that have not been wanted for longest. */
  unload() {
    if (this.loaded <= this.held) return;
    const idle = this.nodes.filter((node) => node.part && node.touched !== this.time && node !== this.root);
    for (const node of idle.sort((a, b) => a.touched - b.touched)) {
      if (this.loaded <= this.held) return;
      this.loaded -= node.part.count;
      node.part.dispose();
      node.part = null;
    }
  }

  /** The parts shown. */
  parts() {
    return this.shown.map((node) => node.part);
  }

  settle() {
    if (this.queue.pending.size) return;
    for (const resolve of this.waiting.splice(0)) resolve();
  }

  /** Resolves when nothing more will be loaded for the current view. */
  settled() {
    return this.queue.pending.size ? new Promise((resolve) => this.waiting.push(resolve)) : Promise.resolve();
  }
}
