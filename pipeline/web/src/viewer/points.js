// Point clouds: the sparse points of structure from motion, and the dense cloud.

import { BufferAttribute, BufferGeometry, Points, ShaderMaterial, Vector3 } from "three";

const SIZE_PX = 3.5;
const NEAREST_PX = 1.5; // of dense points, however far
const FILL = 1.6; // of the distance between points: diagonals, and slopes seen from above
const REACH_PX = 10; // from a click

/**
 * Make an empty, hidden point cloud.
 * @param {number} spacing Distance between points, which they fill when near; 0 if it is not known.
 */
export function makePoints(spacing = 0) {
  const geometry = new BufferGeometry();
  const material = new ShaderMaterial({
    uniforms: { size: { value: SIZE_PX }, spacing: { value: spacing }, rows: { value: 1 } },
    defines: { FILL },
    vertexShader: `
attribute vec3 rgb;
varying vec3 colour;
uniform float size;
uniform float spacing;
uniform float rows;
void main() {
  colour = rgb;
  gl_Position = projectionMatrix * modelViewMatrix * vec4(position, 1.0);
  gl_PointSize = max(size, 0.5 * FILL * spacing * projectionMatrix[1][1] * rows / gl_Position.w);
}`,
    fragmentShader: "varying vec3 colour;\nvoid main() { gl_FragColor = vec4(colour, 1.0); }", // unchanged: sRGB
  });
  const points = new Points(geometry, material);
  points.frustumCulled = false;
  points.visible = false;
  points.onBeforeRender = (renderer) => {
    material.uniforms.size.value = (spacing ? NEAREST_PX : SIZE_PX) * renderer.getPixelRatio();
    material.uniforms.rows.value = renderer.domElement.height;
  };
  return points;
}

/** Fill in the points. @param {{xyz: Float32Array, rgb: Uint8Array}} found */
export function fillPoints(points, { xyz, rgb }) {
  points.geometry.setAttribute("position", new BufferAttribute(xyz, 3));
  points.geometry.setAttribute("rgb", new BufferAttribute(rgb, 3, true));
}

/** The foremost point near a window position, or null. */
export function nearestPoint(points, view, x, y) {
  const xyz = points.geometry.getAttribute("position")?.array ?? [];
  const { fx, fy, cx, cy } = view.intrinsics();
  const { right, up, forward } = view.axes();
  const eye = view.position.clone().sub(points.position);
  let [best, least] = [-1, Infinity];
  for (let i = 0; i < xyz.length; i += 3) { // view.project inlined, without its vectors for each of 250,000 points
    const [x0, y0, z0] = [xyz[i] - eye.x, xyz[i + 1] - eye.y, xyz[i + 2] - eye.z];
    const depth = x0 * forward.x + y0 * forward.y + z0 * forward.z;
    const across = cx + (fx * (x0 * right.x + y0 * right.y + z0 * right.z)) / depth;
    const down = cy - (fy * (x0 * up.x + y0 * up.y + z0 * up.z)) / depth;
    const off = Math.hypot(across - x, down - y);
    if (depth <= 0 || off > REACH_PX) continue;
    const cost = depth * (1 + off / REACH_PX);
    if (cost < least) [best, least] = [i, cost];
  }
  return best < 0 ? null : new Vector3().fromArray(xyz, best).add(points.position);
}
