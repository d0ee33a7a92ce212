// A photo on a canvas that can be zoomed to single pixels: sharp, and redrawn only when something has changed.

const MAX_PIXELS = 150e6; // of decoded photos in memory, 4 bytes each
const LARGEST_ZOOM = 40;
const SHARP_FROM = 1.5; // device pixels per photo pixel from which pixels are drawn as squares
const SMALL_WIDTH = 1600; // of the copy drawn when zoomed out: reducing a large photo is slow
const DRAG_PX = 4; // a shorter movement is a click
const TAP_MS = 600;

export class Photos {
  constructor() {
    this.kept = new Map(); // number -> { bitmap: Promise, pixels }
  }

  get(number, size) {
    let entry = this.kept.get(number);
    if (entry) this.kept.delete(number);
    else entry = { bitmap: load(number), pixels: size.width * size.height };
    this.kept.set(number, entry);
    entry.bitmap.catch(() => this.kept.delete(number));
    let total = 0;
    for (const [other, { bitmap, pixels }] of [...this.kept].reverse()) {
      total += pixels;
      if (total > MAX_PIXELS && other !== number) {
        this.kept.delete(other);
        bitmap.then(({ whole, small }) => [whole, small].forEach((image) => image.close()), () => 0);
      }
    }
    return entry.bitmap;
  }
}

async function load(number) {
  const answer = await fetch(`photo/${number}`);
  if (!answer.ok) throw new Error((await answer.text()).trim());
  const whole = await createImageBitmap(await answer.blob());
  const resizeWidth = Math.min(SMALL_WIDTH, whole.width);
  return { whole, small: await createImageBitmap(whole, { resizeWidth, resizeQuality: "high" }) };
}

export class Picture {
  // `on.click([x, y])` gets photo pixels, with the first one's corner at (0, 0); `on.paint(drawing)` draws the overlay.
  constructor(canvas, overall, on) {
    Object.assign(this, { canvas, overall, on, bitmap: null, size: null, x: 0, y: 0, zoom: 1, pointer: null });
    this.touches = new Map();
    new ResizeObserver(() => this.resize()).observe(canvas);
    canvas.addEventListener("wheel", (event) => this.wheel(event), { passive: false });
    for (const kind of ["pointerdown", "pointermove", "pointerup", "pointercancel", "pointerleave"]) {
      canvas.addEventListener(kind, (event) => this[kind](event));
    }
    overall.addEventListener("pointerdown", (event) => this.jump(event));
    this.resize();
  }

  resize() {
    const ratio = devicePixelRatio || 1;
    this.width = this.canvas.clientWidth;
    this.height = this.canvas.clientHeight;
    this.canvas.width = Math.round(this.width * ratio);
    this.canvas.height = Math.round(this.height * ratio);
    this.draw();
  }

  show(bitmap, size) {
    this.bitmap = bitmap;
    this.size = size;
    this.draw();
  }

  get fit() {
    return this.size ? Math.min(this.width / this.size.width, this.height / this.size.height) : 1;
  }

  look(x, y, zoom) {
    this.zoom = Math.min(LARGEST_ZOOM, Math.max(this.fit * 0.9, zoom));
    this.x = x;
    this.y = y;
    this.draw();
  }

  fitAll() {
    this.look(this.size.width / 2, this.size.height / 2, this.fit);
  }

  zoomBy(factor, at = [this.width / 2, this.height / 2]) {
    const [x, y] = this.photoAt(at);
    this.zoom = Math.min(LARGEST_ZOOM, Math.max(this.fit * 0.9, this.zoom * factor));
    this.x = x - (at[0] - this.width / 2) / this.zoom;
    this.y = y - (at[1] - this.height / 2) / this.zoom;
    this.draw();
  }

  screenAt([x, y]) {
    return [(x - this.x) * this.zoom + this.width / 2, (y - this.y) * this.zoom + this.height / 2];
  }

  photoAt([x, y]) {
    return [this.x + (x - this.width / 2) / this.zoom, this.y + (y - this.height / 2) / this.zoom];
  }

  // Moves the view only if a position would be out of sight.
  keepInSight(place) {
    const [x, y] = this.screenAt(place);
    const margin = 40;
    if (x < margin || y < margin || x > this.width - margin || y > this.height - margin) {
      this.look(place[0], place[1], this.zoom);
    }
  }

  draw() {
    this.frame ??= requestAnimationFrame(() => {
      this.frame = null;
      this.paint();
    });
  }

  paint() {
    const context = this.canvas.getContext("2d", { alpha: false });
    const ratio = this.canvas.width / Math.max(1, this.width);
    context.setTransform(1, 0, 0, 1, 0, 0);
    context.fillStyle = "#20242a";
    context.fillRect(0, 0, this.canvas.width, this.canvas.height);
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    if (this.bitmap) {
      const [left, top] = this.screenAt([0, 0]);
      context.imageSmoothingEnabled = this.zoom * ratio < SHARP_FROM;
      context.imageSmoothingQuality = "high";
      const isFar = this.zoom * ratio * this.size.width <= this.bitmap.small.width;
      context.drawImage(isFar ? this.bitmap.small : this.bitmap.whole, left, top, this.size.width * this.zoom, this.size.height * this.zoom);
    }
    this.on.paint(context, this);
    this.paintOverall();
  }

  paintOverall() {
    const context = this.overall.getContext("2d");
    const { width, height } = this.overall;
    context.clearRect(0, 0, width, height);
    this.overall.hidden = !this.bitmap || this.zoom < this.fit * 1.3;
    if (this.overall.hidden) return;
    const scale = Math.min(width / this.size.width, height / this.size.height);
    context.imageSmoothingQuality = "high";
    context.drawImage(this.bitmap.small, 0, 0, this.size.width * scale, this.size.height * scale);
    const [x0, y0] = this.photoAt([0, 0]);
    const [x1, y1] = this.photoAt([this.width, this.height]);
    context.strokeStyle = "#ffb000";
    context.lineWidth = 2;
    context.strokeRect(x0 * scale, y0 * scale, Math.max(4, (x1 - x0) * scale), Math.max(4, (y1 - y0) * scale));
  }

  jump(event) {
    const box = this.overall.getBoundingClientRect();
    const scale = Math.min(this.overall.width / this.size.width, this.overall.height / this.size.height);
    const [x, y] = [event.clientX - box.left, event.clientY - box.top];
    this.look((x * this.overall.width) / box.width / scale, (y * this.overall.height) / box.height / scale, this.zoom);
  }

  place(event) {
    const box = this.canvas.getBoundingClientRect();
    return [event.clientX - box.left, event.clientY - box.top];
  }

  wheel(event) {
    event.preventDefault();
    this.zoomBy(Math.exp(-event.deltaY * (event.deltaMode ? 0.05 : 0.0015)), this.place(event));
  }

  pointerdown(event) {
    this.canvas.setPointerCapture(event.pointerId);
    this.touches.set(event.pointerId, this.place(event));
    if (this.touches.size === 1) this.drag = { start: this.place(event), moved: false, at: event.timeStamp };
    else this.drag = null; // a pinch is not a click
  }

  pointermove(event) {
    const before = this.touches.get(event.pointerId);
    const place = this.place(event);
    this.pointer = event.pointerType === "touch" ? null : place;
    if (before) {
      if (this.touches.size === 2) this.pinch(event.pointerId, before, place);
      else this.pan(before, place);
      this.touches.set(event.pointerId, place);
    }
    this.draw();
  }

  pan(before, place) {
    if (!this.drag) return;
    const far = Math.hypot(place[0] - this.drag.start[0], place[1] - this.drag.start[1]) > DRAG_PX;
    if (!far && !this.drag.moved) return;
    const from = this.drag.moved ? before : this.drag.start;
    this.drag.moved = true;
    this.x -= (place[0] - from[0]) / this.zoom;
    this.y -= (place[1] - from[1]) / this.zoom;
  }

  pinch(id, before, place) {
    const other = [...this.touches].find(([key]) => key !== id)[1];
    const length = (a, b) => Math.max(1, Math.hypot(a[0] - b[0], a[1] - b[1]));
    this.zoomBy(length(place, other) / length(before, other), other);
  }

  pointerup(event) {
    const wasAlone = this.touches.size === 1;
    this.touches.delete(event.pointerId);
    const { drag } = this;
    if (!wasAlone || !drag) return;
    this.drag = null;
    const slow = event.pointerType === "touch" && event.timeStamp - drag.at > TAP_MS;
    if (!drag.moved && !slow && event.button === 0 && this.bitmap) this.on.click(this.photoAt(drag.start));
  }

  pointercancel(event) {
    this.touches.delete(event.pointerId);
    this.drag = null;
  }

  pointerleave() {
    this.pointer = null;
    this.draw();
  }
}
