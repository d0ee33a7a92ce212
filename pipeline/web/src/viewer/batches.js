// Spark draws one instance per splat. This costs a software renderer about 6 µs each, whatever is drawn (a million:
// 28 s), and wastes most of a GPU's vertex lanes. Here an instance is a batch of many splats: the same images, in 3 s.
// In WebGL 2 the highest index always means primitive restart (OpenGL ES 3.0, 2.8.1).

import { BufferAttribute } from "three";

const BATCH = 16383; // splats per instance: four vertices each, by 16-bit indices below 65535, the restart index
const CORNERS = [-1, -1, 0, 1, -1, 0, 1, 1, 0, -1, 1, 0];
const TRIANGLES = [0, 1, 2, 0, 2, 3];

// Replacements in spark's vertex shader, once each. The last one skips pixels that would certainly be discarded for
// being fainter than minAlpha, and enlarges the splats of a draft, since there are fewer of them.
const REPLACEMENTS = [
  ["void main() {", `uniform int drawnSplats;\nuniform int splatStride;\nvoid main() {\nint place = (gl_InstanceID * ${BATCH} + (gl_VertexID >> 2)) * splatStride;`],
  [
    "ivec2 orderingCoord = ivec2((gl_InstanceID >> 2) & 4095, gl_InstanceID >> 14);",
    "if (place >= drawnSplats) return;\nivec2 orderingCoord = ivec2((place >> 2) & 4095, place >> 14);",
  ],
  ["texelFetch(ordering, orderingCoord, 0)[gl_InstanceID & 3]", "texelFetch(ordering, orderingCoord, 0)[place & 3]"],
  ["vRgba.a = rgba.a;", "vRgba.a = rgba.a;\nadjustedStdDev = min(adjustedStdDev, sqrt(max(0.0, 2.0 * log(rgba.a / minAlpha))));\nvSplatUv = position.xy * adjustedStdDev;"],
  ["vec3 ndcCenter =", "ndcOffset *= sqrt(float(splatStride));\nvec3 ndcCenter ="],
];

/**
 * Make a SparkRenderer draw in batches.
 * @returns {(stride: number) => void} Sets the draft mode: only every stride-th splat is drawn, larger.
 */
export function drawInBatches(spark) {
  let shader = spark.material.vertexShader;
  for (const [theirs, ours] of REPLACEMENTS) {
    if (shader.split(theirs).length !== 2) throw new Error(`spark's vertex shader has changed: ${theirs}`);
    shader = shader.replace(theirs, ours);
  }
  spark.material.vertexShader = shader;
  const corners = new Float32Array(BATCH * 12);
  const indices = new Uint16Array(BATCH * 6);
  for (let splat = 0; splat < BATCH; splat++) {
    corners.set(CORNERS, splat * 12);
    for (let i = 0; i < 6; i++) indices[splat * 6 + i] = splat * 4 + TRIANGLES[i];
  }
  spark.geometry.setAttribute("position", new BufferAttribute(corners, 3));
  spark.geometry.setIndex(new BufferAttribute(indices, 1));
  spark.uniforms.drawnSplats = { value: 0 };
  spark.uniforms.splatStride = { value: 1 };
  const theirs = spark.onBeforeRender;
  spark.onBeforeRender = function (...context) {
    theirs.apply(this, context);
    spark.uniforms.drawnSplats.value = spark.activeSplats;
    spark.geometry.instanceCount = Math.ceil(spark.activeSplats / spark.uniforms.splatStride.value / BATCH);
  };
  return (stride) => (spark.uniforms.splatStride.value = stride);
}
