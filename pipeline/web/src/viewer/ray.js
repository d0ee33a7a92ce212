// Ray casting: the median depth of the Gaussians along a ray, as in our rasterizer (RenderOptions.for_depths).

import { Vector3 } from "three";

const ALPHA_MIN = 1 / 255;
const ALPHA_MAX = 0.99;
const BLUR_PX2 = 0.3;
const MEDIAN = 0.5; // transmittance at which the surface is
const SHIFT_MAX = 0.5; // largest difference of a Gaussian's depth on the ray from its centre's, a share of the latter
const SIGMAS2 = 2 * Math.log(255);

let halves = null; // lookup table of all half floats

function halfValues() {
  const values = new Float32Array(65536);
  for (let bits = 0; bits < 65536; bits++) {
    const exponent = (bits >> 10) & 31;
    const fraction = bits & 1023;
    const sign = bits & 32768 ? -1 : 1;
    if (exponent === 31) values[bits] = fraction ? NaN : sign * Infinity;
    else values[bits] = sign * (exponent ? (1 + fraction / 1024) * 2 ** (exponent - 15) : fraction * 2 ** -24);
  }
  return values;
}

/**
 * @param {RayCaster[]} casters Casters of all splats.
 * @param {Vector3} origin @param {Vector3} direction Unit, world.
 * @param {Vector3} forward The view's axis: Gaussians are sorted by depth along it.
 * @param {{near: number, pixel: number}} limits Near plane, and a pixel's angle.
 * @returns {Vector3 | null} The point in the world.
 */
export function meet(casters, origin, direction, forward, limits) {
  const met = casters.flatMap((caster) => caster.hits(origin, direction, forward, limits));
  met.sort((a, b) => a.depth - b.depth);
  const cosine = direction.dot(forward);
  let light = 1;
  for (const { alpha, at } of met) {
    light *= 1 - alpha;
    if (light <= MEDIAN) return new Vector3().copy(origin).addScaledVector(direction, at / cosine);
  }
  return null;
}

export class RayCaster {
  /** @param splats Spark's ExtSplats; their frame is the world's rotated to y up (x, z, -y). @param {number[]} zero Their origin in the world. */
  constructor(splats, zero) {
    this.splats = splats;
    this.zero = zero;
    this.reach2 = null;
  }

  /** Precompute centres, squared reaches and a bounding sphere, which are all that the search uses. */
  prepare() {
    halves ??= halfValues();
    const count = this.splats.numSplats;
    const [first, second] = this.splats.extArrays;
    this.centres = new Float32Array(first.buffer, first.byteOffset, first.length);
    this.reach2 = new Float32Array(count);
    const [least, most] = [[0, 1, 2].map(() => Infinity), [0, 1, 2].map(() => -Infinity)];
    for (let i = 0; i < count; i++) {
      const a = halves[second[4 * i + 1] >>> 16];
      const b = halves[second[4 * i + 2] & 65535];
      const c = halves[second[4 * i + 2] >>> 16];
      this.reach2[i] = Math.exp(2 * Math.max(a, b, c)) * SIGMAS2;
      const reach = Math.sqrt(this.reach2[i]);
      for (let axis = 0; axis < 3; axis++) {
        least[axis] = Math.min(least[axis], this.centres[4 * i + axis] - reach);
        most[axis] = Math.max(most[axis], this.centres[4 * i + axis] + reach);
      }
    }
    const [low, high] = [new Vector3(...least), new Vector3(...most)];
    this.sphere = { centre: low.clone().add(high).multiplyScalar(0.5), radius: low.distanceTo(high) / 2 };
  }

  /** Whether a ray may hit any of them; arguments in their frame. */
  passes(origin, direction, blur2) {
    const offset = this.sphere.centre.clone().sub(origin);
    const away = offset.length();
    const farthest = away + this.sphere.radius;
    const along = offset.dot(direction);
    if (along < -this.sphere.radius) return false;
    return Math.sqrt(Math.max(0, away * away - along * along)) <= this.sphere.radius + farthest * Math.sqrt(SIGMAS2 * blur2);
  }

  /** The ray's hits: alphas with their depths, see `meet`. */
  hits(origin, direction, forward, { near, pixel }) {
    if (!this.reach2) this.prepare();
    const [ox, oy, oz] = [origin.x - this.zero[0], origin.z - this.zero[2], this.zero[1] - origin.y];
    const [dx, dy, dz] = [direction.x, direction.z, -direction.y];
    const [fx, fy, fz] = [forward.x, forward.z, -forward.y];
    const { centres, reach2 } = this;
    const cosine = direction.dot(forward);
    const blur2 = BLUR_PX2 * pixel * pixel;
    const met = [];
    if (!this.passes(new Vector3(ox, oy, oz), new Vector3(dx, dy, dz), blur2)) return met;
    for (let i = 0, j = 0; i < reach2.length; i++, j += 4) {
      const [x, y, z] = [centres[j] - ox, centres[j + 1] - oy, centres[j + 2] - oz];
      const along = x * dx + y * dy + z * dz;
      const off2 = x * x + y * y + z * z - along * along;
      if (off2 > reach2[i] + SIGMAS2 * blur2 * along * along || along <= 0) continue;
      const depth = x * fx + y * fy + z * fz;
      if (depth < near) continue;
      const hit = this.response(i, [x, y, z], [dx, dy, dz], blur2 * along * along);
      if (hit.alpha < ALPHA_MIN) continue;
      const limit = SHIFT_MAX * depth;
      met.push({ depth, alpha: hit.alpha, at: Math.min(Math.max(hit.at * cosine, depth - limit), depth + limit) });
    }
    return met;
  }

  /** A Gaussian's largest alpha on a ray, and its position along the ray. */
  response(i, [x, y, z], [dx, dy, dz], blur2) {
    const { scales, quaternion, opacity } = this.splats.getSplat(i);
    const place = new Vector3(x, y, z).applyQuaternion(quaternion.conjugate()); // in the Gaussian's axes
    const ray = new Vector3(dx, dy, dz).applyQuaternion(quaternion);
    let [aa, ab, bb] = [0, 0, 0]; // dot products of position and ray, divided by the sigmas
    for (const axis of ["x", "y", "z"]) {
      const weight = 1 / (scales[axis] * scales[axis] + blur2);
      aa += weight * place[axis] * place[axis];
      ab += weight * place[axis] * ray[axis];
      bb += weight * ray[axis] * ray[axis];
    }
    return { alpha: Math.min(ALPHA_MAX, opacity * Math.exp(-0.5 * Math.max(0, aa - (ab * ab) / bb))), at: ab / bb };
  }
}
