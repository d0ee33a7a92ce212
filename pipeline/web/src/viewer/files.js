// Fetches files beside the page: one, or many of which a few at a time are fetched, most important first.

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
 * Fetch and process a file, with a few retries.
 * @template T
 * @param {string} address
 * @param {(bytes: Uint8Array) => Promise<T>} use Processes the bytes; rejects if the file is damaged.
 * @param {object} how As for `fetchBytes`.
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
   * @param {number} atOnce Number of concurrent requests.
   * @param {(address: string, bytes: Uint8Array) => Promise<void>} use Processes a file; rejects if it is damaged.
   * @param {(address: string, error: Error) => void} failed Called once there are no more retries.
   */
  constructor(atOnce, use, failed) {
    Object.assign(this, { atOnce, use, failed });
    this.pending = new Set(); // in order of importance
    this.running = new Map(); // abort controllers by address
  }

  /** Set the files to fetch, in order; other requests in progress are aborted. */
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
