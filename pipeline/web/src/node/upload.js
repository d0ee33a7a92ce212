// Uploads a capture's files: what the node has already is left out, a few at a time, again until they are there.
//
// Progress counts files that the node has whole, and the bytes of those under way: what was sent twice counts once.

import { RefusedError, getJson, sendFile } from "./server.js";

const AT_ONCE = 3;
const FIRST_WAIT_MS = 1000, LONGEST_WAIT_MS = 30_000;
const NETWORK = 0, STOPPED = -1, TOO_MANY = 429, FULL = 507;

export class Upload {
  /** `files` as of `capture()`; `onChange` is called whenever something has changed. */
  constructor(uuid, files, onChange) {
    this.uuid = uuid;
    this.files = files;
    this.onChange = onChange;
    this.total = files.reduce((sum, { file }) => sum + file.size, 0);
    this.doneBytes = 0;
    this.doneFiles = 0;
    this.refused = []; // [{ name, why }]: the node or the disk said no, and would again
    this.trouble = ""; // why it waits
    this.running = false;
    this.stopped = false;
    this.under = new Map(); // names under way and their bytes sent
    this.began = performance.now();
    this.sentBytes = 0;
  }

  get sent() {
    return this.doneBytes + [...this.under.values()].reduce((sum, bytes) => sum + bytes, 0);
  }

  get complete() {
    return this.doneFiles + this.refused.length === this.files.length && !this.refused.length;
  }

  /** Seconds left at the pace so far; NaN until there is one. */
  get left() {
    const seconds = (performance.now() - this.began) / 1000;
    const pace = (this.sent - this.skippedBytes) / seconds;
    return pace > 0 && seconds > 2 ? (this.total - this.sent) / pace : NaN;
  }

  /** Upload until all is there or refused; resolves then. Never rejects. */
  async run() {
    if (this.running || this.stopped) return;
    this.running = true;
    this.refused = [];
    this.onChange();
    const have = await this.#insist(async () => (await getJson(`api/files/${this.uuid}`)).files);
    if (have) {
      const missing = this.files.filter(({ name, file }) => have[name] !== file.size);
      const there = this.files.filter(({ name, file }) => have[name] === file.size);
      this.doneFiles = there.length;
      this.doneBytes = this.skippedBytes = there.reduce((sum, { file }) => sum + file.size, 0);
      this.began = performance.now();
      const queue = missing[Symbol.iterator]();
      await Promise.all(Array.from({ length: AT_ONCE }, () => this.#work(queue)));
    }
    this.running = false;
    this.onChange();
  }

  stop() {
    this.stopped = true;
    for (const request of this.requests ?? []) request.abort();
  }

  async #work(queue) {
    for (const { name, file } of queue) {
      if (this.stopped) return;
      const done = await this.#insist(() => this.#send(name, file), name, file);
      this.under.delete(name);
      if (done) {
        this.doneFiles += 1;
        this.doneBytes += file.size;
      }
      this.onChange();
    }
  }

  async #send(name, file) {
    this.under.set(name, 0);
    const path = `api/upload/${this.uuid}?name=${encodeURIComponent(name)}`;
    const { request, end } = sendFile(path, file, (bytes) => {
      this.under.set(name, Math.min(bytes, file.size));
      this.onChange();
    });
    this.requests = (this.requests ?? new Set()).add(request);
    try {
      await end;
      return true;
    } finally {
      this.requests.delete(request);
    }
  }

  /** Do something until it works; null if it never will. */
  async #insist(action, name = "", file = null) {
    for (let wait = FIRST_WAIT_MS; !this.stopped; wait = Math.min(2 * wait, LONGEST_WAIT_MS)) {
      try {
        const result = await action();
        this.trouble = "";
        return result;
      } catch (error) {
        if (!(error instanceof RefusedError)) throw error;
        if (error.status === STOPPED) return null;
        if (file && !(await readable(file))) {
          this.refused.push({ name, why: "cannot be read from your disk any more (was a card taken out, or the file changed?)" });
          return null;
        }
        const passes = [NETWORK, TOO_MANY, FULL].includes(error.status) || error.status >= 500;
        if (!passes || error.noRetry) {
          this.refused.push({ name, why: error.message });
          return null;
        }
        this.under.delete(name);
        this.trouble = `${error.message} Trying again every ${Math.round(wait / 1000)} s.`;
        this.onChange();
        await new Promise((resolve) => setTimeout(resolve, wait));
      }
    }
    return null;
  }
}

async function readable(file) {
  try {
    await file.slice(0, 1).arrayBuffer();
    return true;
  } catch {
    return false;
  }
}
