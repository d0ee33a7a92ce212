// The splats of a site: the coarse whole first, then finer where one looks. A node stays until all of its children are
// there to stand for it, so that there is never a hole.

import { FileQueue } from "./files.js";
import { wantedLevels } from "./levels.js";
import { readPart } from "./part.js";

const PIXELS = 8; // of the screen: a smaller error is not refined; its Gaussians stand half a pixel from the truth
const NARROW = "(max-width: 640px), (max-height: 520px), (pointer: coarse)";
const MOST = { wide: 3_000_000, narrow: 800_000 }; // Gaussians seen: what a computer, and what a phone does smoothly
const HELD = 1.5; // times as many are in memory at most, those out of sight as well: each takes 200 bytes
const LITTLE_MEMORY_GB = 4; // of the machine: then as on a phone
const AT_ONCE = { wide: 4, narrow: 2 }; // files: each is decoded by a worker with memory of its own

function size() {
  const small = matchMedia(NARROW).matches || (navigator.deviceMemory ?? Infinity) < LITTLE_MEMORY_GB;
  return small ? "narrow" : "wide";
}

export class LevelStream {
  /**
   * @param {object[]} nodes As `readLevels` gives them.
   * @param {import("./stage.js").Stage} stage
   * @param {(error: Error) => void} failed Told of the first file that cannot be had.
   */
  constructor(nodes, stage, failed) {
    this.root = nodes[0];
    this.nodes = nodes;
    this.byFile = new Map(nodes.map((node) => [node.file, node]));
    this.stage = stage;
    this.failed = failed;
    this.limit(MOST[size()]);
    this.refined = new Set();
    this.shown = [];
    this.loaded = 0; // Gaussians
    this.time = 0; // counts the views
    this.waiting = [];
    this.queue = new FileQueue(AT_ONCE[size()], (...file) => this.take(...file), (...file) => this.miss(...file));
    addEventListener("online", () => this.retry());
  }

  /** How many Gaussians are seen at most, and with them how many are in memory. */
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

  /** Ask for what a view wants, and show of it what is there. */
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

  /** Loaded nodes that together stand for a node, as fine as wanted; null where there are none. */
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

  /** Nodes that were let go of while their descendants were shown, which are finer than wanted. */
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
    if (!this.told) this.failed(error);
    this.told = true;
    this.stage.invalidate();
  }

  /** The network is back. */
  retry() {
    for (const node of this.nodes) node.failed = false;
    this.stage.invalidate();
  }

  /** Let go of what has not been wanted for longest. */
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

  /** What is shown. */
  parts() {
    return this.shown.map((node) => node.part);
  }

  settle() {
    if (this.queue.pending.size) return;
    for (const resolve of this.waiting.splice(0)) resolve();
  }

  /** Resolves when nothing more is to come for the present view. */
  settled() {
    return this.queue.pending.size ? new Promise((resolve) => this.waiting.push(resolve)) : Promise.resolve();
  }
}
