// The page's requests to the server. A change that was not saved on disk stays in the browser's storage and is sent
// again, also by the next page opened, if the user agrees: no mark is lost if the server or the machine goes down. The
// storage belongs to an address and a port, which other programs, and other users', may have had in the meantime.

const RETRY_MS = 2000;
const NAMED = 12; // changes that the question about them names

export async function fetchJson(path) {
  const answer = await fetch(path);
  if (!answer.ok) throw new Error(await whyNot(answer));
  return answer.json();
}

async function whyNot(answer) {
  const text = (await answer.text()).trim();
  try {
    const { message, hint } = JSON.parse(text);
    return `${message} ${hint}`.trim();
  } catch {
    return text || `The server answered ${answer.status}.`;
  }
}

export async function post(path, body) {
  const headers = { "content-type": "application/json" };
  const answer = await fetch(path, { method: "POST", headers, body: JSON.stringify(body) });
  if (answer.ok) return answer.json();
  const error = new Error(await whyNot(answer));
  error.status = answer.status;
  throw error;
}

function question(waiting) {
  const named = waiting.slice(0, NAMED).map((change) => `${change.point} in ${change.photo}`);
  const more = waiting.length > NAMED ? ` and ${waiting.length - NAMED} more` : "";
  return `Not saved yet, from a page that was closed: ${named.join(", ")}${more}.\n\nSave now? Cancel discards.`;
}

export class Outbox {
  // Pending changes, in order; `onResult` is called with answers and errors.
  constructor(key, numbers, onResult) {
    this.key = `splatpipe.marks:${key}`;
    this.numbers = numbers;
    this.onResult = onResult;
    this.waiting = [];
    this.sending = null;
    this.trouble = "";
    try {
      const kept = JSON.parse(localStorage.getItem(this.key)) ?? [];
      if (kept.length && confirm(question(kept))) this.waiting = kept;
    } catch {
      // Nothing that a page of ours has kept, or a browser without storage.
    }
    this.keep();
    if (this.waiting.length) this.send();
  }

  get count() {
    return this.waiting.length;
  }

  add(change) {
    const last = this.waiting.at(-1);
    const same = last && last.point === change.point && last.photo === change.photo;
    if (same && change.nudge && last.action === "mark" && this.waiting.length > (this.sending ? 1 : 0)) {
      this.waiting[this.waiting.length - 1] = { ...change, nudge: last.nudge };
    } else {
      this.waiting.push(change);
    }
    this.keep();
    return this.send();
  }

  keep() {
    try {
      if (this.waiting.length) localStorage.setItem(this.key, JSON.stringify(this.waiting));
      else localStorage.removeItem(this.key);
    } catch {
      // A browser without storage: the page itself still holds them.
    }
    this.onResult({});
  }

  // Resolves when nothing is pending any more, or when something has to be sent later.
  send() {
    this.sending ??= this.sendAll().finally(() => (this.sending = null));
    return this.sending;
  }

  async sendAll() {
    while (this.waiting.length) {
      const change = this.waiting[0];
      const [point, photo] = this.numbers(change);
      try {
        if (point < 0 || photo < 0) throw Object.assign(new Error("This point or photo is no longer in this run."), { status: 400 });
        const answer = await post("api/mark/change", { ...change, point, photo });
        this.trouble = "";
        this.waiting.shift();
        this.keep();
        this.onResult({ answer });
      } catch (error) {
        if (error.status === 400) {
          this.waiting.shift(); // it will never be accepted
          this.keep();
          this.onResult({ refused: `${change.point} in ${change.photo}: ${error.message}` });
          continue;
        }
        this.trouble = error.status ? error.message : "The server does not answer.";
        this.onResult({});
        setTimeout(() => this.send(), RETRY_MS);
        return;
      }
    }
  }
}
