// Draws a splat file with spark, or a GLB read by three and drawn by spark: window.draw(...) for a test.

import { Color, Matrix4, PerspectiveCamera, Quaternion, Scene, Vector3, WebGLRenderer } from "three";
import { GLTFLoader } from "three/addons/loaders/GLTFLoader.js";
import { ExtSplats, SparkRenderer, SplatMesh } from "@sparkjsdev/spark";

const BLUR_PX2 = 0.3; // this and the two below match the rasterizer that it is compared with
const ALPHA_MIN = 1 / 255;
const SIGMAS = Math.sqrt(2 * Math.log(255));
const SH_C0 = 0.28209479177387814;
const NEAR = 0.1;
const FAR = 1e5;
const pause = (ms) => new Promise((resolve) => setTimeout(resolve, ms));

async function splatsOf(url, type) {
  const bytes = new Uint8Array(await (await fetch(url)).arrayBuffer());
  const splats = type === "glb" ? await splatsOfGlb(bytes) : new ExtSplats({ fileBytes: bytes, fileType: type });
  await splats.initialized;
  return splats;
}

/** By three's loader: names of attributes that it does not know come in small letters. Colours without harmonics. */
async function splatsOfGlb(bytes) {
  const { scene } = await new GLTFLoader().parseAsync(bytes.buffer, "");
  let points;
  scene.traverse((object) => object.isPoints && (points = object));
  const of = (name) => points.geometry.getAttribute(name && `khr_gaussian_splatting:${name}`);
  const position = points.geometry.getAttribute("position");
  const [rotation, scale, opacity, dc] = ["rotation", "scale", "opacity", "sh_degree_0_coef_0"].map(of);
  const splats = new ExtSplats({ maxSplats: position.count });
  for (let i = 0; i < position.count; i++) {
    const colour = [dc.getX(i), dc.getY(i), dc.getZ(i)].map((value) => 0.5 + SH_C0 * value);
    splats.pushSplat(
      new Vector3().fromBufferAttribute(position, i),
      new Vector3().fromBufferAttribute(scale, i),
      new Quaternion().fromBufferAttribute(rotation, i),
      opacity.getX(i),
      new Color(...colour),
    );
  }
  return new ExtSplats({ extArrays: splats.extArrays, numSplats: position.count }); // pushed ones stay invisible: spark 2.2.0
}

/**
 * A picture of a file.
 * @param {{url: string, type: string, width: number, height: number, focal: number[], camFromFile: number[],
 *   antialias: boolean, background: number}} asked `camFromFile` row by row; the camera's x right, y down, z forward.
 * @returns {Promise<{splats: number, png: string}>} How many splats were read, and a data URL.
 */
window.draw = async (asked) => {
  const { width, height, focal, antialias } = asked;
  const canvas = document.createElement("canvas");
  const context = canvas.getContext("webgl2", { antialias: false, alpha: false, preserveDrawingBuffer: true });
  const renderer = new WebGLRenderer({ canvas, context, antialias: false, alpha: false });
  renderer.setPixelRatio(1);
  renderer.setSize(width, height, false);
  renderer.setClearColor(0, 1);
  const spark = new SparkRenderer({
    renderer,
    autoUpdate: false,
    enableLod: false,
    blurAmount: antialias ? BLUR_PX2 : 0,
    preBlurAmount: antialias ? 0 : BLUR_PX2,
    minAlpha: ALPHA_MIN,
    maxStdDev: SIGMAS,
    maxPixelRadius: 4096,
    sortRadial: false,
  });
  const splats = await splatsOf(asked.url, asked.type);
  const scene = new Scene();
  scene.add(spark, new SplatMesh({ extSplats: splats }));
  const camera = new PerspectiveCamera();
  camera.matrixAutoUpdate = false;
  camera.near = NEAR;
  camera.far = FAR;
  camera.matrix.set(...asked.camFromFile).premultiply(new Matrix4().makeScale(1, -1, -1)).invert();
  camera.matrix.decompose(camera.position, camera.quaternion, camera.scale);
  // prettier-ignore
  camera.projectionMatrix.set(
    (2 * focal[0]) / width, 0, 0, 0,
    0, (2 * focal[1]) / height, 0, 0,
    0, 0, (NEAR + FAR) / (NEAR - FAR), (2 * NEAR * FAR) / (NEAR - FAR),
    0, 0, -1, 0,
  );
  camera.projectionMatrixInverse.copy(camera.projectionMatrix).invert();
  scene.updateMatrixWorld(true);
  camera.updateMatrixWorld(true);
  await spark.update({ scene, camera });
  while (spark.sorting || spark.sortDirty) await pause(10);
  renderer.render(scene, camera);
  const png = canvas.toDataURL("image/png");
  renderer.dispose();
  return { splats: splats.numSplats, png };
};
