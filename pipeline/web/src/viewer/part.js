// The splats of one SPZ file, for rendering and for ray casting.

import { ExtSplats, SplatMesh } from "@sparkjsdev/spark";
import { LoadError } from "./error.js";
import { RayCaster } from "./ray.js";

const SH_TEXTURES = { sh1: "sh1Texture", sh2: "sh2Texture", sh3a: "sh3TextureA", sh3b: "sh3TextureB" }; // spark's names

export class SplatPart {
  /** @param {ExtSplats} splats @param {number[]} origin Their origin in the world. */
  constructor(splats, origin) {
    this.splats = splats;
    this.count = splats.numSplats;
    this.mesh = new SplatMesh({ extSplats: splats });
    this.mesh.quaternion.set(Math.SQRT1_2, 0, 0, Math.SQRT1_2); // from the file's y up to the world's z up
    this.mesh.position.fromArray(origin);
    this.mesh.updateMatrixWorld(true);
    this.caster = new RayCaster(splats, origin);
    this.forget();
  }

  /** Free the spherical harmonics once the GPU has them: two thirds of a splat's bytes. */
  forget() {
    const { extra } = this.splats;
    this.splats.ensureShTextures(); // spark would create them on first draw
    for (const [name, its] of Object.entries(SH_TEXTURES)) {
      const texture = extra[its]?.value;
      if (!texture) continue; // a lower degree has none
      texture.onUpdate = () => {
        texture.image.data = null;
        extra[name] = true; // spark still checks that it exists
      };
    }
  }

  dispose() {
    this.mesh.removeFromParent();
    this.mesh.dispose();
    this.splats.dispose();
  }
}

/** Decode an SPZ file (y up) whose origin is at `origin` in the world. */
export async function readPart(bytes, origin = [0, 0, 0]) {
  const splats = new ExtSplats({ fileBytes: bytes, fileType: "spz" }); // float32 centres: half floats have steps of centimetres
  try {
    await splats.initialized;
  } catch {
    throw new LoadError("The splat cannot be read.", "It may be damaged or cut off: copy it again, or export it again.");
  }
  return new SplatPart(splats, origin);
}
