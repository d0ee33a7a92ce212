// The sparse points of structure from motion.

import { BufferAttribute, BufferGeometry, Points, ShaderMaterial, Vector3 } from "three";

const SIZE_PX = 3.5;
const REACH_PX = 10; // from a click

export function makePoints(xyz, rgb) {
  const geometry = new BufferGeometry();
  geometry.setAttribute("position", new BufferAttribute(xyz, 3));
  geometry.setAttribute("rgb", new BufferAttribute(rgb, 3, true));
  const material = new ShaderMaterial({
    uniforms: { size: { value: SIZE_PX } },
    vertexShader: `
attribute vec3 rgb;
varying vec3 colour;
uniform float size;
void main() {
  colour = rgb;
  gl_Position = projectionMatrix * modelViewMatrix * vec4(position, 1.0);
  gl_PointSize = size;
}`,
    fragmentShader: "varying vec3 colour;\nvoid main() { gl_FragColor = vec4(colour, 1.0); }", // as they are: sRGB
  });
  const points = new Points(geometry, material);
  points.frustumCulled = false;
  points.visible = false;
  points.onBeforeRender = (renderer) => (material.uniforms.size.value = SIZE_PX * renderer.getPixelRatio());
  return points;
}

/** The foremost point near a place in the window; null where none is. */
export function nearestPoint(points, view, x, y) {
  const xyz = points.geometry.getAttribute("position").array;
  const point = new Vector3();
  let [best, least] = [null, Infinity];
  for (let i = 0; i < xyz.length; i += 3) {
    const at = view.project(point.fromArray(xyz, i));
    const off = Math.hypot(at.x - x, at.y - y);
    if (at.depth <= 0 || off > REACH_PX) continue;
    const cost = at.depth * (1 + off / REACH_PX);
    if (cost < least) [best, least] = [point.clone(), cost];
  }
  return best;
}
