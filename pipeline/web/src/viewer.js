// viewer.html shows the splat in any browser, offline; a site's index.html loads it in levels of detail. viewer.py and
// site.py write the pages; the modules are in viewer/.
//
// For scripts and tests there is `window.splatpipe`:
//   ready                 a promise: the first complete frame is on the screen (rejected if loading failed); on a site,
//                         the rest of this API exists only then
//   complete()            a promise: a complete frame of the current view, in full detail, is on the screen
//   cameraState()         {position, yaw, pitch, roll, fx, fy, cx, cy, width, height, photo}: world units, radians, CSS px
//   setCamera({position, target} or {position, yaw, pitch, roll})   look from there, at once
//   goToCamera(name, atOnce = true)   the view of a photo; false if there is none of that name
//   project([x, y, z])    {x, y, depth}: window position of a world point, CSS px
//   pick(x, y)            [x, y, z]: the world point at a window position, or null
//   crsOf([x, y, z])      its coordinates in the run's CRS, or null if there is none
//   measure(from, to, kind = "distance")   {distance, horizontal, height}, drawn like one made by hand
//   show(layer)           a promise: "splat", "mesh" or "points" is shown, if the run made it; false if it did not
//   showPoints(on), showCameras(on), showInterface(on)
//   picture()             a promise: the current view as a PNG data URL
//   shown()               {gaussians, files}: what is drawn; files of the levels of detail, if any
//   limit(count)          on a site: most Gaussians in view; by default the page sets a limit for the device
//   facts                 the facts the page was made with

import { Box3, Vector3 } from "three";
import { fillStrip, Frusta, frustumDepth } from "./viewer/cameras.js";
import { coordinateLabels, toCrs } from "./viewer/crs.js";
import { LoadError } from "./viewer/error.js";
import { fetchPatiently } from "./viewer/files.js";
import { Layers } from "./viewer/layers.js";
import { readLevels } from "./viewer/levels.js";
import { Measuring } from "./viewer/measure.js";
import { acceptFile, loaded, note, progress, showMessage } from "./viewer/messages.js";
import { Navigation } from "./viewer/navigation.js";
import { bytesOf, readFacts, readMeasurements, readPoints, readSplat, readSurfaces } from "./viewer/page.js";
import { readPart } from "./viewer/part.js";
import { fillPoints, makePoints, nearestPoint } from "./viewer/points.js";
import { meet } from "./viewer/ray.js";
import { Results } from "./viewer/results.js";
import { makeSky } from "./viewer/sky.js";
import { Stage } from "./viewer/stage.js";
import { LevelStream } from "./viewer/stream.js";
import { View } from "./viewer/view.js";

const FAR_PER_SIZE = 1e4; // of the scene's size: the far plane must not clip the background
const HOVER_MS = 60;
const FILLED = 0.85; // of the free part of the window, by the target of a move

const $ = (id) => document.getElementById(id);
const array = (vector) => [vector.x, vector.y, vector.z];
const vector = (values) => new Vector3(...values);

class Viewer {
  constructor(facts) {
    this.facts = facts;
    this.photos = facts.cameras;
    this.view = new View({ near: facts.near, far: facts.size * FAR_PER_SIZE });
    this.centre = vector(facts.centre);
    this.photo = null; // the photo whose view this is
    this.last = null; // the last one chosen, from which next and previous count
    this.tool = null;
  }

  async start() {
    const { facts, view } = this;
    const levels = facts.levels && this.fetchLevels(facts.levels);
    levels?.catch(() => null); // reported where it is awaited
    this.stage = new Stage($("canvas"), facts);
    view.changed = () => {
      this.photo = null;
      this.strip?.choose(null);
      this.stage.invalidate(true);
    };
    this.frusta = new Frusta(this.photos, frustumDepth(this.photos), () => this.stage.invalidate());
    this.measuring = new Measuring($("labels"), $("lines"), facts, () => this.stage.invalidate());
    this.results = this.makeResults();
    this.layers = new Layers(readSurfaces(), {
      add: (object) => this.stage.scene.add(object),
      changed: () => this.showPoints(false),
      failed: (error) => note(`It cannot be shown: ${error.message}`),
    });
    this.stage.scene.add(this.frusta.group);
    this.stage.beforeDraw = () => this.beforeDraw();
    this.stage.failed = (error) => showMessage(`Drawing failed: ${error.message}`, "Reload this page, or try another browser.");
    this.stage.canvas.addEventListener("webglcontextlost", () => showMessage("The graphics card stopped drawing.", "Reload this page."));
    new ResizeObserver(() => this.stage.resize()).observe(this.stage.canvas);
    if (facts.sky) this.stage.scene.add(makeSky(await bytesOf(facts.sky.colours), facts.sky, facts.background));
    this.points = makePoints();
    this.stage.scene.add(this.points);
    this.goTo(this.photos[facts.start], true);
    this.controls();
    if (!facts.levels) {
      await this.addSmallParts();
      return this.show(await readSplat(facts, progress));
    }
    await this.stream(...(await levels));
    this.addSmallParts(); // in separate files that nothing waits for
  }

  async addSmallParts() {
    this.strip.paint();
    fillPoints(this.points, await readPoints(this.facts.points));
    this.stage.invalidate();
  }

  /** Sections and volumes; null if none were measured. */
  makeResults() {
    const measured = readMeasurements();
    for (const element of document.querySelectorAll(".for-results")) element.hidden = !measured;
    if (!measured) return null;
    const results = new Results(measured, {
      changed: () => this.stage.invalidate(),
      look: (...there) => this.lookAt(...there),
    });
    this.stage.scene.add(results.traces.group);
    return results;
  }

  /** Show a complete splat. */
  async show(bytes) {
    this.part = await readPart(bytes);
    this.stage.show([this.part]);
    await this.stage.complete();
    loaded();
  }

  /** Request the tree and its root, before setting up WebGL blocks the page. */
  fetchLevels({ tree, root, bytes }) {
    return Promise.all([readLevels(tree), fetchPatiently(root, async (file) => file, { progress, total: bytes })]);
  }

  /** Show a splat in levels of detail: first all of it, coarse, then refined where the view is. */
  async stream(nodes, bytes) {
    const stream = new LevelStream(nodes, this.stage, (error) => note(`Some of the model stays coarse: ${error.message} Reload to try again.`));
    await stream.begin(bytes);
    await this.stage.glimpse();
    this.levels = stream;
    this.stage.invalidate();
    loaded();
  }

  /** Resolves when the current view is on the screen in full detail. */
  async complete() {
    do {
      await this.stage.complete();
      await this.levels?.settled();
    } while (!this.stage.whole);
  }

  beforeDraw() {
    const { view, stage } = this;
    view.size = { width: stage.width, height: stage.height };
    view.apply(stage.camera);
    this.levels?.update(view);
    this.frusta.update(view);
    this.measuring.update(view);
    this.results?.traces.update(view);
    $("north").style.transform = `rotate(${view.yaw - Math.PI / 2}rad)`;
  }

  controls() {
    const { facts } = this;
    this.navigation = new Navigation(this.stage.canvas, this.view, {
      size: facts.size,
      pick: (x, y) => this.pick(x, y),
      centre: () => this.centre.clone(),
      click: (x, y) => this.click(x, y),
      hover: (x, y) => this.hover(x, y),
      leave: () => this.leave(),
    });
    this.strip = fillStrip($("strip"), this.photos, (photo) => this.goTo(photo));
    this.strip.choose(this.photo);
    const actions = {
      home: () => this.goTo(this.photos[facts.start]),
      fly: () => this.setFlying(!this.navigation.flying),
      points: () => this.showPoints(!this.points.visible),
      cameras: () => this.showCameras(!this.frusta.group.visible),
      results_button: () => this.results?.show(!this.results.shown),
      distance: () => this.use("distance"),
      height: () => this.use("height"),
      undo: () => {
        this.measuring.undo();
        this.showMeasurement(null);
      },
      ...this.layers.actions,
      screenshot: () => this.screenshot(),
      help_button: () => ($("help").open ? $("help").close() : $("help").showModal()),
    };
    const keys = { h: "home", f: "fly", p: "points", c: "cameras", v: "results_button", m: "distance", t: "height", x: "screenshot", 1: "splat_layer", 2: "mesh_layer", 3: "points_layer", "?": "help_button", Backspace: "undo", Delete: "undo" };
    for (const [name, action] of Object.entries(actions)) $(name)?.addEventListener("click", action);
    $("close").addEventListener("click", () => $("help").close());
    addEventListener("keydown", (event) => {
      if (event.ctrlKey || event.metaKey || event.altKey) return;
      if (event.key === "Escape") this.use(null);
      else if (event.key === "Tab" || $("help").open) return;
      else actions[keys[event.key.length === 1 ? event.key.toLowerCase() : event.key]]?.();
      const by = { n: 1, b: -1 }[event.key.toLowerCase()];
      if (by && !$("help").open) this.step(by);
    });
    this.showCameras(false);
  }

  /** The next or previous photo's view. */
  step(by) {
    const count = this.photos.length;
    this.goTo(this.photos[(this.photos.indexOf(this.last) + by + count) % count]);
  }

  goTo(photo, atOnce) {
    if (!photo) return false;
    this.last = photo;
    this.view.travel(this.view.poseOf(photo), atOnce, () => {
      this.photo = photo;
      this.strip?.choose(photo);
    });
    return true;
  }

  /** A pose to change: that of the photo whose lens is in use, else of the start photo. */
  pose() {
    return this.view.poseOf(this.view.lens.rotation ? this.view.lens : this.photos[this.facts.start]);
  }

  /**
   * Move to a view of all the given places.
   *
   * @param {Vector3[]} places
   * @param {Vector3 | null} forward Horizontal; null for the current direction.
   * @param {number} pitch Radians.
   * @param {{x: number, y: number, width: number, height: number}} free The part of the window to fill, given by its
   *   centre and size, CSS pixels.
   */
  lookAt(places, forward, pitch, free) {
    const to = this.pose();
    to.size = this.view.size;
    Object.assign(to, { yaw: forward ? Math.atan2(forward.y, forward.x) : this.view.yaw, pitch, roll: 0 });
    const box = new Box3().setFromPoints(places);
    const middle = box.getCenter(new Vector3());
    const { fx, fy, cx, cy } = to.intrinsics();
    const { right, up, forward: ahead } = to.axes();
    let away = 0;
    for (const place of places) {
      const from = place.clone().sub(middle);
      const [across, high, near] = [Math.abs(from.dot(right)), Math.abs(from.dot(up)), from.dot(ahead)];
      away = Math.max(away, (2 * across * fx) / (FILLED * free.width) - near, (2 * high * fy) / (FILLED * free.height) - near);
    }
    to.position = middle.addScaledVector(ahead, -away);
    to.position.addScaledVector(right, ((cx - free.x) * away) / fx).addScaledVector(up, ((free.y - cy) * away) / fy);
    this.view.travel(to);
  }

  pick(x, y) {
    const { view } = this;
    if (this.points.visible) return nearestPoint(this.points, view, x, y);
    if (this.layers.shown !== "splat") return this.layers.pick(view, x, y);
    const { forward } = view.axes();
    const limits = { near: this.facts.near, pixel: 1 / view.intrinsics().fx };
    return meet(this.parts().map((part) => part.caster), view.position, view.ray(x, y), forward, limits);
  }

  /** The parts of the splat that are drawn. */
  parts() {
    return this.levels ? this.levels.parts() : this.part ? [this.part] : [];
  }

  click(x, y) {
    const photo = this.tool ? null : this.frusta.at(this.view, x, y);
    if (photo) return this.goTo(photo);
    const point = this.pick(x, y);
    this.showCoordinates(point);
    if (!this.tool) return;
    if (!point) {
      $("hint").textContent = "No surface here: click on the model.";
      return;
    }
    const result = this.measuring.click(point);
    this.showMeasurement(result);
  }

  hover(x, y) {
    const photo = this.tool ? null : this.frusta.at(this.view, x, y);
    if (this.frusta.mark(photo)) this.stage.invalidate();
    $("canvas").classList.toggle("on-camera", photo !== null);
    const tip = $("tip");
    tip.hidden = !photo;
    if (photo) {
      tip.textContent = photo.held_out ? `${photo.name} · held out` : photo.name;
      tip.style.transform = `translate(${Math.min(x + 14, this.stage.width - 180)}px, ${Math.max(8, y - 30)}px)`;
    }
    const now = performance.now();
    if (now - (this.hovered ?? 0) < HOVER_MS || this.view.journey) return;
    this.hovered = now;
    const point = this.pick(x, y);
    this.showCoordinates(point);
    if (this.tool) this.measuring.hover(point);
  }

  leave() {
    $("tip").hidden = true;
    if (this.frusta.mark(null)) this.stage.invalidate();
  }

  showCoordinates(point) {
    const values = point ? coordinateLabels(this.facts, array(point)) : [];
    $("coordinates").textContent = values.map(([label, value]) => `${label} ${value}`).join("   ");
    $("where").classList.toggle("off", !point);
  }

  use(kind) {
    this.tool = this.tool === kind ? null : kind;
    this.measuring.use(this.tool);
    for (const name of ["distance", "height"]) $(name).setAttribute("aria-pressed", String(this.tool === name));
    document.body.classList.toggle("measuring", this.tool !== null);
    this.showMeasurement(null);
  }

  showMeasurement(result) {
    const { measuring } = this;
    const hint = $("hint");
    hint.hidden = !this.tool && !result;
    if (result) {
      const { distance, horizontal, height } = result;
      hint.textContent = `Length ${measuring.formatLength(distance)} · horizontal ${measuring.formatLength(horizontal)} · height ${measuring.formatLength(height, true)}`;
    } else if (this.tool) {
      hint.textContent = measuring.first ? "Click the second point." : "Click the first point. Esc to finish, Backspace to undo.";
    }
  }

  setFlying(flying) {
    this.navigation.flying = flying;
    $("fly").setAttribute("aria-pressed", String(flying));
  }

  showPoints(shown) {
    this.points.visible = shown;
    this.layers.hide(shown);
    this.stage.showSplats(!shown && this.layers.shown === "splat");
    $("points").setAttribute("aria-pressed", String(shown));
  }

  showCameras(shown) {
    if (shown) this.frusta.paint();
    this.frusta.group.visible = shown;
    $("cameras").setAttribute("aria-pressed", String(shown));
    this.stage.invalidate();
  }

  async picture() {
    await this.complete();
    const canvas = await this.stage.picture();
    this.measuring.draw(canvas, canvas.width / this.stage.width);
    return canvas;
  }

  async screenshot() {
    const canvas = await this.picture();
    const blob = await new Promise((resolve) => canvas.toBlob(resolve, "image/png"));
    const link = document.createElement("a");
    link.href = URL.createObjectURL(blob);
    link.download = `${this.facts.title.replace(/[^\p{L}\p{N}_-]+/gu, "_") || "view"}.png`;
    link.click();
    setTimeout(() => URL.revokeObjectURL(link.href), 10000);
  }

  /** window.splatpipe, see the top of this file. */
  api(ready) {
    return {
      ready,
      facts: this.facts,
      complete: () => this.complete(),
      cameraState: () => {
        const { position, yaw, pitch, roll, size } = this.view;
        return { position: array(position), yaw, pitch, roll, ...this.view.intrinsics(), ...size, photo: this.photo?.name ?? null };
      },
      setCamera: ({ position, target, yaw, pitch, roll = 0 }) => {
        const to = this.pose();
        to.position = vector(position);
        if (target) to.face(vector(target).sub(to.position).normalize(), this.view.axes().right);
        Object.assign(to, target ? { roll: 0 } : { yaw, pitch, roll });
        this.view.travel(to, true);
      },
      goToCamera: (name, atOnce = true) => this.goTo(this.photos.find((photo) => photo.name === name), atOnce),
      project: (point) => this.view.project(vector(point)),
      pick: (x, y) => {
        const point = this.pick(x, y);
        return point && array(point);
      },
      crsOf: (point) => (this.facts.crs ? toCrs(this.facts.crs, point) : null),
      measure: (from, to, kind = "distance") => {
        const { distance, horizontal, height } = this.measuring.add(kind, vector(from), vector(to));
        return { distance, horizontal, height };
      },
      show: (layer) => this.layers.show(layer),
      showPoints: (on) => this.showPoints(on),
      showCameras: (on) => this.showCameras(on),
      showInterface: (on) => document.body.classList.toggle("bare", !on),
      shown: () => {
        const gaussians = this.parts().reduce((sum, part) => sum + part.count, 0);
        return { gaussians, files: this.levels?.shown.map((node) => node.file) ?? [] };
      },
      limit: (count) => this.levels?.limit(count),
      picture: async () => (await this.picture()).toDataURL("image/png"),
    };
  }
}

const viewer = new Viewer(readFacts());
const ready = viewer.start();
window.splatpipe = viewer.api(ready);
ready.catch((error) => {
  const known = error instanceof LoadError;
  const beside = viewer.facts.splat?.inlined === false;
  showMessage(known ? error.message : `The model cannot be shown: ${error.message}`, known ? error.hint : "Try another browser.", beside);
  if (viewer.stage && beside) acceptFile((bytes) => viewer.show(bytes));
});
