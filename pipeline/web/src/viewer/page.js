// What the page carries: the facts of the scene and, in most pages, the splat itself.

const CHUNK = 1 << 22; // letters decoded at a time where the browser has no decoder of its own; a multiple of 4

export class LoadError extends Error {
  /** @param {string} message What is wrong. @param {string} hint What to do about it. */
  constructor(message, hint) {
    super(message);
    this.hint = hint;
  }
}

/** The facts that viewer.py wrote; see ViewerScene there. */
export function readFacts() {
  return JSON.parse(document.getElementById("scene").textContent);
}

/** What measured_viewer.py put into the page; null where nothing was measured. */
export function readMeasurements() {
  return JSON.parse(document.getElementById("measurements").textContent);
}

/** Bytes of base64 text, without holding up the page for long. */
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

/** The splat's file: out of the page, or from the address beside it. */
export async function readSplat(facts, progress) {
  const inlined = document.getElementById("splat");
  if (inlined) {
    try {
      const text = inlined.textContent.trim();
      inlined.remove();
      return await bytesOf(text, progress);
    } catch {
      throw new LoadError("The splat in this page is damaged.", "Copy the page again, or make it anew: splatpipe run.");
    }
  }
  if (location.protocol === "file:") {
    throw new LoadError(
      `This model is large, so it lies beside the page, in ${facts.splat.address}. Browsers do not let a page that was ` +
        "opened from a disk read its neighbours.",
      `Drop ${facts.splat.address} onto this page or choose it below; or run "splatpipe view" on the folder.`,
    );
  }
  return await fetchSplat(facts.splat, progress);
}

async function fetchSplat({ address, bytes: total }, progress) {
  let answer;
  try {
    answer = await fetch(address);
  } catch {
    throw new LoadError(`${address} cannot be reached.`, "Is the server still running? Start it again and reload this page.");
  }
  if (!answer.ok) {
    throw new LoadError(`${address} is not there (${answer.status}).`, "It has to lie beside this page: copy both.");
  }
  const parts = [];
  let count = 0;
  const reader = answer.body.getReader();
  for (;;) {
    const { done, value } = await reader.read();
    if (done) break;
    parts.push(value);
    count += value.length;
    progress(total ? count / total : 0);
  }
  return new Uint8Array(await new Blob(parts).arrayBuffer());
}
