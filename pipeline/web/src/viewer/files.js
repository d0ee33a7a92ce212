// Files from beside the page: one, or many that are fetched a few at a time, the most wanted first.

import { LoadError } from "./error.js";

const ATTEMPTS = 3;
const WAIT_MS = 500; // before the second attempt; four times that before the third

/**
 * A file's bytes.
 * @param {string} address Relative to the page.
 * @param {{total?: number, progress?: (share: number) => void, signal?: AbortSignal, cache?: RequestCache}} how
 */
export async function fetchBytes(address, { total = 0, progress = () => {}, signal, cache = "default" } = {}) {
  let answer;
  const name = address.split("?")[0];
  try {
    answer = await fetch(address, { signal, cache });
  } catch (error) {
    if (signal?.aborted) throw error;
    throw new LoadError(`${name} cannot be loaded.`, "Is the server still running? Start it again and reload this page.");
  }
  if (!answer.ok) {
    throw new LoadError(`${name} is missing (${answer.status}).`, "It must be in the same folder as this page: copy both.");
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

/**
 * What is made of a file's bytes, tried a few times.
 * @template T
 * @param {string} address
 * @param {(bytes: Uint8Array) => Promise<T>} use Rejects where the file is damaged.
 * @param {object} how As `fetchBytes`.
 * @returns {Promise<T>}
 */
export async function fetchPatiently(address, use, how = {}) {
  for (let attempt = 1; ; attempt++) {
    try {
      return await use(await fetchBytes(address, { ...how, cache: attempt > 1 ? "reload" : "default" }));
    } catch (error) {
      if (attempt === ATTEMPTS || how.signal?.aborted) throw error;
      await new Promise((resolve) => setTimeout(resolve, WAIT_MS * 4 ** (attempt - 1)));
    }
  }
}

export class FileQueue {
  /**
   * @param {number} atOnce How many requests.
   * @param {(address: string, bytes: Uint8Array) => Promise<void>} use Takes a file; rejects where it is damaged.
   * @param {(address: string, error: Error) => void} failed Told once no further attempt is made.
   */
  constructor(atOnce, use, failed) {
    Object.assign(this, { atOnce, use, failed });
    this.pending = new Set(); // in the order in which they are wanted
    this.running = new Map(); // what ends each of them, by address
  }

  /** These and no others, in this order: what is under way and not among them is ended. */
  want(addresses) {
    this.pending = new Set(addresses);
    for (const [address, controller] of this.running) {
      if (this.pending.has(address)) continue;
      controller.abort();
      this.running.delete(address);
    }
    this.begin();
  }

  begin() {
    for (const address of this.pending) {
      if (this.running.size >= this.atOnce) return;
      if (this.running.has(address)) continue;
      const controller = new AbortController();
      this.running.set(address, controller);
      this.run(address, controller.signal);
    }
  }

  async run(address, signal) {
    let trouble = null;
    try {
      await fetchPatiently(address, (bytes) => this.use(address, bytes, signal), { signal });
    } catch (error) {
      trouble = error;
    }
    if (signal.aborted) return;
    this.running.delete(address);
    this.pending.delete(address);
    if (trouble) this.failed(address, trouble);
    this.begin();
  }
}
