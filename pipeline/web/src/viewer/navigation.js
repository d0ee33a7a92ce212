// Mouse, touch and keys: rotate, pan and zoom; a click without movement is passed on.

import { Vector3 } from "three";

const TURN_PER_PX = 0.005; // radians
const CLICK_PX = { mouse: 4, pen: 8, touch: 12 };
const APPROACH = 0.0012; // logarithmic share of the distance per wheel step of 1 px
const FLY_PER_SECOND = 0.25; // of the scene's size
const FLY_TURN_PER_SECOND = 0.9; // radians
const FAST = 4; // with shift
const MOVES = { w: [0, 0, 1], s: [0, 0, -1], a: [-1, 0, 0], d: [1, 0, 0], e: [0, 1, 0], q: [0, -1, 0] };
const TURNS = { ArrowLeft: [1, 0], ArrowRight: [-1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };

export class Navigation {
  /**
   * @param {HTMLElement} canvas
   * @param {import("./view.js").View} view
   * @param {{size: number, pick: (x: number, y: number) => Vector3 | null, centre: () => Vector3,
   *   click: (x: number, y: number) => void, hover: (x: number, y: number) => void, leave: () => void}} scene
   */
  constructor(canvas, view, scene) {
    Object.assign(this, { canvas, view, scene, flying: false, pointers: new Map(), keys: new Set() });
    canvas.addEventListener("pointerdown", (event) => this.down(event));
    canvas.addEventListener("pointermove", (event) => this.move(event));
    for (const name of ["pointerup", "pointercancel"]) canvas.addEventListener(name, (event) => this.up(event));
    canvas.addEventListener("pointerleave", () => scene.leave());
    canvas.addEventListener("wheel", (event) => this.wheel(event), { passive: false });
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
    addEventListener("keydown", (event) => this.key(event, true));
    addEventListener("keyup", (event) => this.key(event, false));
    addEventListener("blur", () => this.keys.clear());
  }

  down(event) {
    this.canvas.setPointerCapture(event.pointerId);
    this.pointers.set(event.pointerId, { x: event.offsetX, y: event.offsetY });
    this.grab(event);
    this.begun = { x: event.offsetX, y: event.offsetY, moved: this.pointers.size > 1 };
  }

  /** The point to hold: on the model under the pointer, else at the scene's distance. */
  grab(event) {
    const { x, y } = this.middle() ?? { x: event.offsetX, y: event.offsetY };
    this.held = this.scene.pick(x, y) ?? this.scene.centre();
  }

  middle() {
    if (this.pointers.size < 2) return null;
    const [a, b] = [...this.pointers.values()];
    return { x: (a.x + b.x) / 2, y: (a.y + b.y) / 2, spread: Math.hypot(a.x - b.x, a.y - b.y) };
  }

  move(event) {
    const before = this.pointers.get(event.pointerId);
    if (!before) return this.scene.hover(event.offsetX, event.offsetY);
    const was = this.middle();
    const now = { x: event.offsetX, y: event.offsetY };
    const reach = CLICK_PX[event.pointerType] ?? CLICK_PX.mouse;
    if (!this.begun.moved && Math.hypot(now.x - this.begun.x, now.y - this.begun.y) < reach) return;
    this.begun.moved = true;
    this.pointers.set(event.pointerId, now);
    const is = this.middle();
    if (is) {
      this.pan(is.x - was.x, is.y - was.y);
      this.approach(Math.log(is.spread / Math.max(was.spread, 1)), this.held);
    } else if (event.buttons & 6 || event.shiftKey) {
      this.pan(now.x - before.x, now.y - before.y);
    } else {
      const [right, down] = [now.x - before.x, now.y - before.y];
      if (this.flying) this.view.turn(right * TURN_PER_PX, down * TURN_PER_PX);
      else this.view.turn(-right * TURN_PER_PX, -down * TURN_PER_PX, this.held);
    }
  }

  up(event) {
    const held = this.pointers.delete(event.pointerId);
    if (held && !this.begun.moved && event.type === "pointerup") this.scene.click(event.offsetX, event.offsetY);
    if (this.pointers.size) this.grab(event);
  }

  /** Pan so that the held point stays under the pointer. */
  pan(right, down) {
    const { fx, fy } = this.view.intrinsics();
    const { right: x, up: y, forward } = this.view.axes();
    const depth = Math.max(this.view.planes.near, new Vector3().subVectors(this.held, this.view.position).dot(forward));
    this.view.shift(new Vector3().addScaledVector(x, (-right * depth) / fx).addScaledVector(y, (down * depth) / fy));
  }

  /** Move towards a point: `amount` 1 reduces the distance to 1/e. */
  approach(amount, point) {
    const offset = new Vector3().subVectors(point, this.view.position);
    const least = 2 * this.view.planes.near;
    const share = 1 - Math.exp(-amount);
    if (offset.length() * (1 - share) < least && share > 0) return;
    this.view.shift(offset.multiplyScalar(share));
  }

  wheel(event) {
    event.preventDefault();
    const now = performance.now();
    if (!this.wheeled || now - this.wheeled.at > 400) {
      this.wheeled = { point: this.scene.pick(event.offsetX, event.offsetY) ?? this.scene.centre() };
    }
    this.wheeled.at = now;
    const lines = event.deltaMode === 1 ? 30 : 1;
    this.approach(-event.deltaY * lines * APPROACH, this.wheeled.point);
  }

  key(event, pressed) {
    const name = event.key.length === 1 ? event.key.toLowerCase() : event.key;
    if (!(name in MOVES) && !(name in TURNS)) return;
    if (pressed && (event.ctrlKey || event.metaKey || event.altKey || event.target.closest?.("input, textarea, dialog[open]"))) return;
    if (pressed) this.keys.add(name);
    else this.keys.delete(name);
    this.fast = event.shiftKey;
    if (name in TURNS) event.preventDefault();
    if (this.keys.size && !this.flight) this.fly(performance.now());
  }

  /** Move as long as keys are held. */
  fly(before) {
    this.flight = requestAnimationFrame(() => {
      this.flight = 0;
      if (!this.keys.size) return;
      const now = performance.now();
      const seconds = Math.min(0.1, (now - before) / 1000);
      const { right, up, forward } = this.view.axes();
      const step = seconds * FLY_PER_SECOND * this.scene.size * (this.fast ? FAST : 1);
      const offset = new Vector3();
      let [yaw, pitch] = [0, 0];
      for (const key of this.keys) {
        const [x, y, z] = MOVES[key] ?? [0, 0, 0];
        offset.addScaledVector(right, x * step).addScaledVector(up, y * step).addScaledVector(forward, z * step);
        const [turn, rise] = TURNS[key] ?? [0, 0];
        yaw += turn * seconds * FLY_TURN_PER_SECOND;
        pitch += rise * seconds * FLY_TURN_PER_SECOND;
      }
      if (offset.lengthSq()) this.view.shift(offset);
      if (yaw || pitch) this.view.turn(yaw, pitch);
      this.fly(now);
    });
  }
}
