// The photos' cameras as frusta with images, and as a strip of thumbnails; both go to the photo's view on a click.

import { BufferAttribute, BufferGeometry, DoubleSide, Group, LineBasicMaterial, LineSegments, Mesh, MeshBasicMaterial, Texture, Vector3 } from "three";

const COLOUR = 0xff9f1c;
const HELD_OUT = 0x2ec4ff;
const CORNERS = [[0, 0], [1, 0], [1, 1], [0, 1]];
const EDGES = [[0, 1], [0, 2], [0, 3], [0, 4], [1, 2], [2, 3], [3, 4], [4, 1]];
const OWN_VIEW = 0.5; // of a frustum's depth: from closer, the frustum itself would cover the view

/** World coordinates of the centre and the image's corners of a frustum of length `depth`. */
function corners(photo, depth) {
  const r = photo.rotation;
  return CORNERS.map(([right, down]) => {
    const x = ((right * photo.width - photo.cx) / photo.fx) * depth;
    const y = ((down * photo.height - photo.cy) / photo.fy) * depth;
    return new Vector3(r[0] * x + r[1] * y + r[2] * depth, r[3] * x + r[4] * y + r[5] * depth, r[6] * x + r[7] * y + r[8] * depth)
      .add(new Vector3(...photo.centre));
  });
}

export class Frusta {
  constructor(photos, depth, changed) {
    this.group = new Group();
    this.group.renderOrder = 1;
    this.depth = depth;
    this.items = photos.map((photo) => this.make(photo, depth));
    this.marked = null;
    this.changed = changed;
    this.painted = false;
  }

  make(photo, depth) {
    const centre = new Vector3(...photo.centre);
    const four = corners(photo, depth);
    const all = [centre, ...four];
    const colour = photo.held_out ? HELD_OUT : COLOUR;
    const lines = new LineSegments(
      new BufferGeometry().setFromPoints(EDGES.flat().map((corner) => all[corner])),
      new LineBasicMaterial({ color: colour, transparent: true, opacity: 0.85, depthWrite: false }),
    );
    const quad = new BufferGeometry().setFromPoints(four);
    quad.setIndex([0, 3, 2, 0, 2, 1]);
    quad.setAttribute("uv", new BufferAttribute(new Float32Array([0, 1, 1, 1, 1, 0, 0, 0]), 2));
    const face = new MeshBasicMaterial({ color: colour, transparent: true, opacity: 0.25, side: DoubleSide, depthWrite: false });
    const picture = new Mesh(quad, face);
    lines.renderOrder = picture.renderOrder = 1;
    this.group.add(lines, picture);
    return { photo, centre, four, lines, picture };
  }

  /** Texture the frusta with the photos, once they are visible. */
  async paint() {
    if (this.painted) return;
    this.painted = true;
    for (const { photo, picture } of this.items.filter((item) => item.photo.thumb)) {
      const image = new Image();
      image.src = photo.thumb;
      await image.decode().catch(() => null);
      if (!image.width) continue;
      const texture = new Texture(image);
      texture.needsUpdate = true;
      texture.colorSpace = "srgb";
      picture.material.map = texture;
      picture.material.color.set(0xffffff);
      picture.material.opacity = 0.8;
      picture.material.needsUpdate = true;
    }
    this.changed();
  }

  /** Hide the frusta that the viewpoint is in. */
  update(view) {
    for (const { centre, lines, picture } of this.items) {
      const away = view.position.distanceTo(centre) > OWN_VIEW * this.depth;
      lines.visible = picture.visible = away;
    }
  }

  /** The photo whose frustum's image is at a window position; the foremost one. */
  at(view, x, y) {
    let [found, nearest] = [null, Infinity];
    if (!this.group.visible) return null;
    for (const item of this.items) {
      if (!item.picture.visible) continue;
      const at = item.four.map((corner) => view.project(corner));
      if (at.some(({ depth }) => depth <= 0) || !inside(at, x, y)) continue;
      const depth = Math.min(...at.map((corner) => corner.depth));
      if (depth < nearest) [found, nearest] = [item, depth];
    }
    return found?.photo ?? null;
  }

  /** Highlight one; returns whether anything changed. */
  mark(photo) {
    if (this.marked === photo) return false;
    this.marked = photo;
    for (const item of this.items) {
      item.lines.material.opacity = item.photo === photo ? 1 : 0.85;
      item.picture.material.opacity = item.photo === photo ? 1 : item.picture.material.map ? 0.8 : 0.25;
    }
    return true;
  }
}

function inside(polygon, x, y) {
  const sides = polygon.map((a, i) => {
    const b = polygon[(i + 1) % polygon.length];
    return (b.x - a.x) * (y - a.y) - (b.y - a.y) * (x - a.x) > 0;
  });
  return sides.every((side) => side === sides[0]);
}

/** Depth of the drawn frusta: a share of the distance to the next camera, so that they do not overlap. */
export function frustumDepth(photos) {
  const centres = photos.map((photo) => new Vector3(...photo.centre));
  const nearest = centres.map((a, i) => Math.min(...centres.map((b, j) => (i === j || a.distanceTo(b) === 0 ? Infinity : a.distanceTo(b)))));
  const known = nearest.filter(Number.isFinite).sort((a, b) => a - b);
  return 0.3 * (known[Math.floor(known.length / 2)] ?? 1);
}

/**
 * The strip of thumbnails.
 * @returns {{choose: (photo: object | null) => void, paint: () => void}} Highlights one; loads the thumbnails.
 */
export function fillStrip(strip, photos, go) {
  const buttons = photos.map((photo) => {
    const button = document.createElement("button");
    button.type = "button";
    button.title = photo.held_out ? `${photo.name} (held out: not trained on)` : photo.name;
    button.className = photo.held_out ? "held-out" : "";
    if (photo.thumb) {
      const image = document.createElement("img");
      image.alt = photo.name;
      image.loading = "lazy";
      image.style.aspectRatio = `${photo.width} / ${photo.height}`; // reserves its space before it is loaded
      button.append(image);
    } else {
      button.textContent = photo.name;
    }
    button.addEventListener("click", () => go(photo));
    strip.append(button);
    return [photo, button];
  });
  let begun = false;
  const choose = (chosen) => {
    for (const [photo, button] of buttons) {
      const is = photo === chosen;
      button.setAttribute("aria-current", String(is));
      if (is && strip.offsetParent) {
        strip.scrollTo({ left: button.offsetLeft - (strip.clientWidth - button.offsetWidth) / 2, behavior: begun ? "smooth" : "instant" });
      }
    }
    begun = true;
  };
  const paint = () => {
    for (const [photo, button] of buttons) if (photo.thumb) button.firstChild.src = photo.thumb;
  };
  return { choose, paint };
}
