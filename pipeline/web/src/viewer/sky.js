// The trained sky: colours by direction, behind everything; below the horizon the background colour shows.

import { BufferAttribute, BufferGeometry, ClampToEdgeWrapping, DataTexture, LinearFilter, Matrix3, Mesh, RepeatWrapping, RGBAFormat, ShaderMaterial, Vector3 } from "three";

const VERTEX = `
varying vec3 ray;
uniform vec4 lens;
uniform mat3 world_from_camera;
void main() {
  ray = world_from_camera * vec3((position.x + lens.z) / lens.x, (position.y + lens.w) / lens.y, -1.0);
  gl_Position = vec4(position.xy, 1.0, 1.0);
}`;
const FRAGMENT = `
varying vec3 ray;
uniform sampler2D sky;
uniform vec3 background;
uniform vec2 degrees;
void main() {
  vec3 d = normalize(ray);
  float elevation = asin(clamp(d.z, -1.0, 1.0));
  vec2 place = vec2(atan(d.y, d.x) / 6.283185307179586 + 0.5, elevation / 3.141592653589793 + 0.5);
  float share = clamp((elevation * 57.29577951308232 - degrees.x) / (degrees.y - degrees.x), 0.0, 1.0);
  gl_FragColor = vec4(mix(background, texture2D(sky, place).rgb, share), 1.0);
}`;

/**
 * @param {Uint8Array} colours RGB of `rows` × 2 `rows` cells, from straight down up, from west via south.
 * @param {{rows: number, nothing_up_to_deg: number, full_from_deg: number}} sky
 * @param {number[]} background
 */
export function makeSky(colours, sky, background) {
  const pixels = new Uint8Array((colours.length / 3) * 4).fill(255);
  for (let i = 0; i < colours.length; i++) pixels[4 * Math.floor(i / 3) + (i % 3)] = colours[i];
  const texture = new DataTexture(pixels, 2 * sky.rows, sky.rows, RGBAFormat);
  texture.magFilter = texture.minFilter = LinearFilter;
  texture.wrapS = RepeatWrapping;
  texture.wrapT = ClampToEdgeWrapping;
  texture.needsUpdate = true;
  const uniforms = {
    sky: { value: texture },
    background: { value: new Vector3(...background) },
    degrees: { value: [sky.nothing_up_to_deg, sky.full_from_deg] },
    lens: { value: [1, 1, 0, 0] },
    world_from_camera: { value: new Matrix3() },
  };
  const material = new ShaderMaterial({ vertexShader: VERTEX, fragmentShader: FRAGMENT, uniforms, depthTest: false, depthWrite: false });
  const triangle = new BufferGeometry();
  triangle.setAttribute("position", new BufferAttribute(new Float32Array([-1, -1, 0, 3, -1, 0, -1, 3, 0]), 3));
  const mesh = new Mesh(triangle, material);
  mesh.frustumCulled = false;
  mesh.renderOrder = -1;
  mesh.onBeforeRender = (_renderer, _scene, camera) => {
    const p = camera.projectionMatrix.elements;
    uniforms.lens.value = [p[0], p[5], p[8], p[9]];
    uniforms.world_from_camera.value.setFromMatrix4(camera.matrixWorld);
  };
  return mesh;
}
