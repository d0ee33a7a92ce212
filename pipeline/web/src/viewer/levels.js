// A site's levels of detail: selects the nodes of the tree for a view. site.py writes the tree, levels.json.

import { Vector3 } from "three";
import { fetchPatiently } from "./files.js";
import { LoadError } from "./error.js";

const KEPT_FROM = 0.5; // of the error at which a node is refined: hysteresis, a refined node stays refined down to this
const MARGIN = 1.2; // of a core's size: nodes just outside the window are refined too
const UNSEEN = 0.25; // cost of a Gaussian out of sight relative to one drawn: it is only sorted

/**
 * Read the tree's nodes, root first.
 * @returns {Promise<{file: string, core: number[][], origin: number[], error: number, count: number, children: object[]}[]>}
 */
export async function readLevels(address) {
  if (location.protocol === "file:") {
    throw new LoadError(
      "This page reads the model from files beside it, which browsers do not allow for a page opened from disk.",
      'Put the whole folder on any web host, or view it on this machine with "splatpipe view" on the run, or with ' +
        '"python3 -m http.server" in this folder.',
    );
  }
  const text = await fetchPatiently(address, async (bytes) => new TextDecoder().decode(bytes));
  try {
    const { nodes } = JSON.parse(text);
    for (const node of nodes) {
      node.children = node.children.map((index) => nodes[index]);
      for (const child of node.children) child.parent = node;
    }
    if (nodes[0].file) return nodes;
  } catch {
    // reported below
  }
  throw new LoadError("levels.json is damaged.", "Copy the folder again, or export it again: splatpipe export.");
}

/** Computes a node's error in the window, pixels, and whether any of the node is in view. */
class Eye {
  constructor(view, ratio) {
    const { fx, fy, cx, cy } = view.intrinsics();
    const { width, height } = view.size;
    const { right, up, forward } = view.axes();
    const plane = (side, across, ahead) => side.clone().multiplyScalar(across).addScaledVector(forward, ahead).normalize();
    this.position = view.position;
    this.sides = [plane(right, fx, cx), plane(right, -fx, width - cx), plane(up, -fy, cy), plane(up, fy, height - cy), forward];
    this.near = view.planes.near;
    this.scale = Math.max(fx, fy) * ratio;
  }

  pixels({ core: [least, most], error }) {
    const distance = Math.hypot(...this.position.toArray().map((at, axis) => Math.max(least[axis] - at, at - most[axis], 0)));
    return (error * this.scale) / Math.max(distance, this.near);
  }

  /** Whether its box reaches inside every plane of the view frustum. */
  sees({ core: [least, most] }) {
    const middle = new Vector3(...least).add(new Vector3(...most)).multiplyScalar(0.5);
    const half = new Vector3(...most).sub(middle).multiplyScalar(MARGIN);
    middle.sub(this.position);
    return this.sides.every((side) => {
      const reach = Math.abs(side.x) * half.x + Math.abs(side.y) * half.y + Math.abs(side.z) * half.z;
      return side.dot(middle) > -reach;
    });
  }

  /** The cost of drawing a node, in Gaussians in view. */
  cost(node) {
    return node.count * (this.sees(node) ? 1 : UNSEEN);
  }
}

/** Nodes sorted by their error in the window, largest first. */
class Ranking {
  constructor() {
    this.items = [];
  }

  add(node, pixels) {
    let [low, high] = [0, this.items.length];
    while (low < high) {
      const middle = (low + high) >> 1;
      if (this.items[middle].pixels < pixels) low = middle + 1;
      else high = middle;
    }
    this.items.splice(low, 0, { node, pixels });
  }

  take() {
    return this.items.pop();
  }
}

/**
 * Select the nodes for a view.
 *
 * @param {object} root
 * @param {import("./view.js").View} view
 * @param {{pixels: number, most: number, held: number, ratio: number, refined: Set<object>}} limits Acceptable error of
 *   a node, screen pixels; most Gaussians in view and in total; screen pixels per CSS pixel; nodes whose descendants are
 *   shown.
 * @returns {{inner: Set<object>, order: object[]}} Nodes to be replaced by their children, and all nodes to be loaded
 *   for that, most important first.
 */
export function wantedLevels(root, view, { pixels, most, held, ratio, refined }) {
  const eye = new Eye(view, ratio);
  const [inner, order] = [new Set(), [root]];
  let [cost, count] = [eye.cost(root), root.count];
  const refine = (node, then) => {
    const costlier = node.children.reduce((sum, child) => sum + eye.cost(child), -eye.cost(node));
    const more = node.children.reduce((sum, child) => sum + child.count, -node.count);
    if (cost + costlier > most || count + more > held) return;
    cost += costlier;
    count += more;
    inner.add(node);
    for (const child of node.children) then(child);
  };
  const [seen, kept] = [new Ranking(), new Ranking()];
  const rank = (node) => {
    if (!node.children.length || node.children.some((child) => child.failed)) return;
    const size = eye.pixels(node);
    if (size > pixels && eye.sees(node)) seen.add(node, size);
    else if (size > pixels * KEPT_FROM && refined.has(node)) kept.add(node, size);
  };
  rank(root);
  for (let next = seen.take(); next; next = seen.take()) {
    refine(next.node, (child) => {
      order.push(child);
      rank(child);
    });
  }
  for (let next = kept.take(); next; next = kept.take()) refine(next.node, rank);
  return { inner, order };
}
