// The page's embedded data: the facts of the scene and, in most pages, the splat itself, or else its URL.

import { LoadError } from "./error.js";
import { fetchBytes } from "./files.js";

const CHUNK = 1 << 22; // characters decoded at a time in browsers without a native decoder; a multiple of 4

/** The facts that viewer.py wrote; see ViewerScene there. */
export function readFacts() {
  return JSON.parse(document.getElementById("scene").textContent);
}

/** The measurements that measured_viewer.py put into the page; null if there are none. */
export function readMeasurements() {
  return JSON.parse(document.getElementById("measurements").textContent);
}

/** What measured_viewer.py put into the page to show instead of the splat; null if nothing. */
export function readSurfaces() {
  return JSON.parse(document.getElementById("surfaces")?.textContent ?? "null");
}

/** Decode base64 text without blocking the page for long. */
export async function bytesOf(text, progress = () => {}) {
  if (Uint8Array.fromBase64) return Uint8Array.fromBase64(text);
  const parts = [];
  for (let at = 0; at < text.length; at += CHUNK) {
    parts.push(Uint8Array.from(atob(text.slice(at, at + CHUNK)), (letter) => letter.charCodeAt(0)));
    progress(at / text.length);
    await new Promise((resolve) => setTimeout(resolve));
  }
  return new Uint8Array(await new Blob(parts).arrayBuffer());
}

/** Bytes of the splat's file, from the page or from its URL beside it. */
export async function readSplat(facts, progress) {
  const inlined = document.getElementById("splat");
  if (inlined) {
    try {
      const text = inlined.textContent.trim();
      inlined.remove();
      return await bytesOf(text, progress);
    } catch {
      throw new LoadError("The splat in this page is damaged.", "Copy the page again, or write it again: splatpipe run.");
    }
  }
  if (location.protocol === "file:") {
    throw new LoadError(
      `This model is large, so it is stored beside the page, in ${facts.splat.address}. Browsers do not let a page that was ` +
        "opened from disk read other files.",
      `Drop ${facts.splat.address} onto this page or choose it below; or run "splatpipe view" on the folder.`,
    );
  }
  return await fetchBytes(facts.splat.address, { progress });
}

/** The sparse points, from the page or from a file beside it; empty if that cannot be loaded. */
export async function readPoints({ xyz, rgb, address, count }) {
  if (!address) {
    const [places, colours] = [await bytesOf(xyz), await bytesOf(rgb)];
    return { xyz: new Float32Array(places.buffer, places.byteOffset, places.length / 4), rgb: colours };
  }
  const bytes = await fetchBytes(address).catch(() => new Uint8Array(0));
  const all = bytes.length === 15 * count ? count : 0; // three floats and three bytes each
  return { xyz: new Float32Array(bytes.buffer, 0, 3 * all), rgb: bytes.subarray(12 * all, 15 * all) };
}
