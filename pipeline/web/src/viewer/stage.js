// The canvas: draws when something has changed, one frame at a time, and reports complete frames.

import { Group, PerspectiveCamera, Scene, WebGLRenderer } from "three";
import { SparkRenderer } from "@sparkjsdev/spark";
import { drawInBatches } from "./batches.js";
import { LoadError } from "./error.js";

const BLUR_PX2 = 0.3; // this and the two below are as in our rasterizer, pipeline/raster/definitions.py
const ALPHA_MIN = 1 / 255;
const SIGMAS = Math.sqrt(2 * Math.log(255)); // an opaque Gaussian is fainter than ALPHA_MIN beyond
const REST_MS = 160; // without movement, after which the view is drawn in full
const POLL_MS = 4;
const SLOW_MS = 120; // slower frames are drawn as drafts while the view moves
const DRAFT_MS = 150; // target duration of a draft
const DRAFT_SPLATS = 150_000; // a software renderer takes 1 µs each, however small
const MIN_RESOLUTION = 0.3; // of a draft
const GLIMPSE_RESOLUTION = 0.5; // of the first frame: a quarter of the pixels, the slow part without a GPU
const MAX_PIXEL_RATIO = 2;

const pause = (ms) => new Promise((resolve) => setTimeout(resolve, ms));

export class Stage {
  /** @param {HTMLCanvasElement} canvas @param {{antialias: boolean, background: number[]}} facts */
  constructor(canvas, facts) {
    const context = canvas.getContext("webgl2", { antialias: false, alpha: false, powerPreference: "high-performance" });
    if (!context) {
      throw new LoadError(
        "This browser has no WebGL 2, which is needed to draw the model.",
        "Use a current Firefox, Chrome, Edge or Safari, and allow hardware acceleration in its settings.",
      );
    }
    this.canvas = canvas;
    this.renderer = new WebGLRenderer({ canvas, context, antialias: false, alpha: false });
    this.renderer.debug.checkShaderErrors = false; // checking blocks the page until the driver has compiled
    this.renderer.setClearColor((facts.background[0] * 255 << 16) | (facts.background[1] * 255 << 8) | (facts.background[2] * 255), 1);
    this.scene = new Scene();
    this.camera = new PerspectiveCamera();
    this.camera.matrixAutoUpdate = false;
    this.spark = new SparkRenderer({
      renderer: this.renderer,
      autoUpdate: false,
      enableLod: false,
      blurAmount: facts.antialias ? BLUR_PX2 : 0,
      preBlurAmount: facts.antialias ? 0 : BLUR_PX2,
      minAlpha: ALPHA_MIN,
      maxStdDev: SIGMAS,
      maxPixelRadius: 4096,
      sortRadial: false,
    });
    this.setStride = drawInBatches(this.spark);
    this.scene.add(this.spark);
    this.beforeDraw = () => {};
    this.failed = () => {};
    this.splats = new Group();
    this.scene.add(this.splats);
    this.begun = false; // nothing is drawn before the first splats
    this.wanted = 0;
    this.movedAt = -Infinity;
    this.fullMs = 0;
    this.splatsShown = true;
    this.waiting = [];
    this.whole = false;
    this.glimpsed = null;
    this.resize();
  }

  /**
   * Set the splats to draw.
   * @param {import("./part.js").SplatPart[]} parts
   */
  show(parts) {
    const meshes = new Set(parts.map((part) => part.mesh));
    this.splats.remove(...this.splats.children.filter((mesh) => !meshes.has(mesh)));
    this.splats.add(...meshes);
    this.begun = true;
    this.invalidate();
  }

  showSplats(shown) {
    this.splatsShown = shown;
    this.spark.visible = this.splats.visible = shown;
    this.invalidate();
  }

  resize() {
    this.width = Math.max(1, this.canvas.clientWidth);
    this.height = Math.max(1, this.canvas.clientHeight);
    this.invalidate();
  }

  /** Request a redraw; `moving`: a draft suffices if drawing is slow. */
  invalidate(moving = false) {
    this.wanted++;
    this.whole = false;
    if (moving) this.movedAt = performance.now();
    this.schedule();
  }

  /** Resolves when a sorted, full frame of the current view is on the screen. */
  complete() {
    return this.whole ? Promise.resolve() : new Promise((resolve) => this.waiting.push(resolve));
  }

  /** Resolves when a first frame at reduced resolution is on the screen; the next one is full. */
  glimpse() {
    return new Promise((resolve) => (this.glimpsed = resolve));
  }

  schedule() {
    if (this.scheduled || this.drawing || !this.begun) return;
    this.scheduled = true;
    const begin = () => {
      this.scheduled = false;
      this.draw().catch((error) => this.failed(error));
    };
    if (document.hidden) setTimeout(begin, POLL_MS);
    else requestAnimationFrame(begin);
  }

  async draw() {
    this.drawing = true;
    const { wanted, glimpsed } = this;
    const resting = performance.now() - this.movedAt > REST_MS;
    const slow = this.fullMs > SLOW_MS;
    this.beforeDraw();
    this.camera.updateMatrixWorld(true);
    const began = performance.now();
    if (this.splatsShown && this.splats.children.length) {
      if (resting || slow || glimpsed) await this.sortNow(); // the first frame must show something, even while moving
      else if (!this.spark.sorting) this.spark.update(this).then(() => this.invalidate(), this.failed);
    }
    this.setQuality(!resting && slow, glimpsed ? GLIMPSE_RESOLUTION : 1);
    this.renderer.render(this.scene, this.camera);
    await this.fence();
    if (glimpsed) return this.endGlimpse();
    if (resting) this.fullMs = performance.now() - began;
    this.drawing = false;
    if (wanted !== this.wanted) this.schedule();
    else if (resting) this.finish();
    else setTimeout(() => this.schedule(), REST_MS);
  }

  /** Update the splats' colours and order for the current view. */
  async sortNow() {
    while (this.spark.sorting) await pause(POLL_MS);
    await this.spark.update(this);
    while (this.spark.sorting || this.spark.sortDirty) await pause(POLL_MS);
  }

  /** Screen pixels per CSS pixel at rest. */
  get fullRatio() {
    return Math.min(window.devicePixelRatio, MAX_PIXEL_RATIO);
  }

  endGlimpse() {
    this.glimpsed();
    this.glimpsed = null;
    this.drawing = false;
    this.schedule();
  }

  setQuality(draft, most) {
    this.setStride(draft ? Math.max(1, Math.ceil(this.spark.activeSplats / DRAFT_SPLATS)) : 1);
    const share = draft ? Math.max(MIN_RESOLUTION, Math.sqrt(DRAFT_MS / this.fullMs)) : 1;
    const ratio = this.fullRatio * Math.min(most, share);
    const { width, height } = this;
    const drawn = this.drawn;
    if (drawn && drawn.ratio === ratio && drawn.width === width && drawn.height === height) return;
    this.drawn = { ratio, width, height };
    this.renderer.setPixelRatio(ratio);
    this.renderer.setSize(width, height, false);
  }

  /** Wait until the GPU is done without blocking the page; no frame starts before. */
  async fence() {
    const gl = this.renderer.getContext();
    const sync = gl.fenceSync(gl.SYNC_GPU_COMMANDS_COMPLETE, 0);
    gl.flush();
    while (sync && !gl.isContextLost() && gl.clientWaitSync(sync, 0, 0) === gl.TIMEOUT_EXPIRED) await pause(POLL_MS);
    gl.deleteSync(sync);
  }

  finish() {
    this.whole = true;
    const waiting = this.waiting;
    this.waiting = [];
    for (const resolve of waiting) resolve();
  }

  /** The current view, in full, as a new canvas. */
  async picture() {
    await this.complete();
    this.renderer.render(this.scene, this.camera);
    const copy = document.createElement("canvas");
    copy.width = this.canvas.width;
    copy.height = this.canvas.height;
    copy.getContext("2d").drawImage(this.canvas, 0, 0);
    return copy;
  }
}
