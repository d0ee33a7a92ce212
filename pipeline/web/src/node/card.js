// One job on the page, from its upload to its results: panels that are drawn again only if what they show has changed,
// so that a form keeps what was typed and the keyboard keeps its place.

import { element } from "../mark/panels.js";
import { OptionsForm } from "./options.js";
import { count, listed, moment, roughly, size } from "./words.js";

const STATES = {
  uploading: "Being prepared",
  waiting: "Waiting",
  running: "Running",
  marks: "Waiting for your marks",
  done: "Finished",
  failed: "Failed",
  cancelled: "Cancelled",
};
const SIGNS = { error: ["✗", "bad"], warning: ["!", "doubt"], note: ["i", "note"] };
const MOST_FINDINGS = 6;
const LOG_LINES = 300;
const ENDED = ["done", "failed", "cancelled", "marks"];

const button = (text, onclick, kind = "") => element("button", { type: "button", class: kind, onclick }, text);

export class JobCard {
  /** `page` has the actions and what the node offers. */
  constructor(task, page) {
    this.page = page;
    this.uuid = task.uuid;
    this.upload = null; // this page's own, while it lasts
    this.left = []; // files of the drop that a run does not use
    this.drawn = new Map();
    this.panels = {};
    this.heading = element("h3", { tabindex: "-1" });
    this.state = element("p", { class: "state" });
    this.facts = element("p", { class: "small" });
    this.root = element("article", { class: "job", "data-uuid": task.uuid }, element("header", {}, this.heading, this.state, this.facts));
    for (const name of ["upload", "check", "progress", "said", "results", "form", "actions", "log"]) {
      this.panels[name] = element("div", { class: name, hidden: true });
      this.root.append(this.panels[name]);
    }
    this.update(task);
  }

  /** Draw what the node says of the task now. */
  update(task) {
    this.task = task;
    this.root.dataset.state = task.state;
    this.heading.textContent = task.name;
    this.state.textContent = this.#stateText();
    this.facts.textContent = this.#factsText();
    this.#draw("upload", task.state === "uploading" && this.#uploadKey(), () => this.#uploadPanel());
    this.#draw("check", (task.state === "uploading" || task.state === "waiting") && (task.check ?? { state: "none" }), () => this.#checkPanel());
    this.#draw("progress", task.state === "running" && [task.progress, task.stage, task.what, Math.round((task.left_s ?? 0) / 20)], () => this.#progressPanel());
    this.#draw("said", (task.message || this.said) && [task.message, task.hint, this.said], () => this.#saidPanel());
    this.#draw("results", task.results?.length && task.results, () => this.#resultsPanel());
    this.#draw("form", this.#wantsForm() && this.task.state, () => [this.task.state === "uploading" ? this.#nameField() : "", this.form().root]);
    this.form_?.forecast(task.check?.forecasts);
    this.#draw("actions", [task.state, this.repeating, task.can, this.upload?.running, this.upload?.complete, task.check?.state, task.check?.verdict], () => this.#actions());
    this.#draw("log", task.state !== "uploading" && "log", () => this.#logPanel());
    if (this.log_?.open) this.#readLog();
  }

  /** Say something about this job that the person should read; empty to take it back. */
  say(text) {
    this.said = text;
    this.update(this.task);
  }

  /** The form, made when it is first wanted. */
  form() {
    this.form_ ??= new OptionsForm(this.page.offered, this.task.options ?? []);
    return this.form_;
  }

  #nameField() {
    const id = `name-${this.uuid}`;
    this.name_ ??= element("input", { type: "text", id, maxlength: "200", value: this.task.name, spellcheck: "false" });
    return element("div", { class: "field" }, element("label", { for: id }, "Name"), this.name_);
  }

  /** The name that was typed. */
  get name() {
    return this.name_?.value.trim() || this.task.name;
  }

  #wantsForm() {
    return this.task.state === "uploading" || this.repeating;
  }

  #draw(name, key, build) {
    const panel = this.panels[name];
    if (!key) {
      panel.hidden = true;
      this.drawn.delete(name);
      panel.replaceChildren();
      return;
    }
    const text = JSON.stringify(key);
    if (this.drawn.get(name) === text) return;
    this.drawn.set(name, text);
    const held = panel.contains(document.activeElement) ? document.activeElement.dataset.keep : null;
    panel.replaceChildren(...build().filter((part) => part != null && part !== ""));
    panel.hidden = !panel.childNodes.length;
    if (held != null) (panel.querySelector(`[data-keep="${held}"]`) ?? this.heading).focus();
  }

  #stateText() {
    const { state, place, why, check } = this.task;
    if (state === "uploading" && this.upload?.running) return "Uploading";
    if (state === "uploading" && check?.state === "done" && (!this.upload || this.upload.complete)) return "Ready to start";
    if (state === "waiting") return `${STATES.waiting}${place ? `, number ${place} in the queue` : ""}${why ? `. ${why}` : ""}`;
    if (state === "done" && this.task.verdict) return `Finished: ${this.task.verdict}`;
    return STATES[state] ?? state;
  }

  #factsText() {
    const { photos, bytes, created_ms, ended_ms, seconds, delete_ms, state } = this.task;
    const facts = [count(photos, "photo"), bytes ? size(bytes) : ""];
    facts.push(ended_ms ? `ended ${moment(ended_ms)}` : `added ${moment(created_ms)}`);
    if (ENDED.includes(state) && seconds > 0) facts.push(`took ${roughly(seconds)}`);
    if (delete_ms) facts.push(`kept until ${moment(delete_ms)}`);
    return facts.filter(Boolean).join(" · ");
  }

  #uploadKey() {
    const up = this.upload;
    return up ? [up.running, up.doneFiles, Math.round((200 * up.sent) / Math.max(1, up.total)), up.trouble, up.refused.length, this.left.length] : ["elsewhere", this.task.files];
  }

  #uploadPanel() {
    const up = this.upload;
    if (!up) return this.#elsewhere();
    const bar = element("progress", { max: up.total || 1, value: up.sent, "aria-label": "uploaded" });
    const words = up.complete
      ? `All ${count(up.files.length, "file")} are here.`
      : `${up.doneFiles.toLocaleString("en")} of ${count(up.files.length, "file")}, ${size(up.sent)} of ${size(up.total)}${up.running && up.left > 0 ? `, ${roughly(up.left)} left` : ""}`;
    const parts = up.complete ? [] : [bar];
    parts.push(element("p", {}, words));
    if (up.trouble) parts.push(element("p", { class: "warning", role: "alert" }, up.trouble));
    if (up.refused.length && !up.running) {
      const rows = up.refused.slice(0, 8).map(({ name, why }) => element("li", {}, element("bdi", {}, name), `: ${why}`));
      if (up.refused.length > rows.length) rows.push(element("li", {}, `and ${up.refused.length - rows.length} more`));
      parts.push(element("p", { class: "warning" }, `${count(up.refused.length, "file")} could not be uploaded.`), element("ul", { class: "refused" }, ...rows));
      parts.push(element("div", { class: "row" }, button("Try again", () => this.page.resume(this)), button("Go on without them", () => this.page.without(this))));
    }
    if (this.left.length) parts.push(this.#leftOut());
    return parts;
  }

  #elsewhere() {
    const { files, expected } = this.task;
    const here = expected && files < expected ? `${files} of ${count(expected, "file")} are here.` : `${count(files ?? 0, "file")} are here.`;
    return [
      element("p", {}, `${here} If that is not all, drop or choose the same folder again: what is here is not sent twice.`),
      element("div", { class: "row" }, button("Choose the folder", () => this.page.choose(this), "")),
    ];
  }

  #leftOut() {
    const names = this.left.map(({ name }) => name);
    const text = `${count(names.length, "file")} of the folder ${names.length === 1 ? "is" : "are"} not used: ${listed(names)}.`;
    return element("p", { class: "small" }, text);
  }

  #checkPanel() {
    const check = this.task.check ?? { state: "none" };
    if (check.state === "none") return [];
    if (check.state === "waiting") return [element("p", { class: "busy" }, "The check begins when another one has ended.")];
    if (check.state === "running") {
      const bar = check.total ? element("progress", { max: check.total, value: check.done, "aria-label": "checked" }) : element("progress", { "aria-label": "checking" });
      return [element("p", { class: "busy" }, `Checking the photos before anything is computed: ${check.what || "beginning"}.`), bar];
    }
    if (check.state === "failed") return [element("p", { class: "warning" }, `The check could not be made: ${check.message}`)];
    return [this.#verdict(check)];
  }

  #verdict(check) {
    const level = { error: "bad", warning: "doubt", note: "good", fine: "good" }[check.verdict] ?? "good";
    const shown = check.findings.slice(0, MOST_FINDINGS);
    const list = element("ul", {}, ...shown.map((finding) => {
      const [sign, tone] = SIGNS[finding.severity];
      return element("li", { class: tone },
        element("span", { class: "sign", "aria-label": finding.severity }, sign),
        finding.message, finding.hint ? element("span", { class: "hint" }, ` ${finding.hint}`) : "");
    }));
    const more = check.findings.length - shown.length;
    return element("section", { class: `verdict ${level}`, "aria-label": "what the check found" },
      element("h4", {}, check.headline), element("p", {}, check.text), shown.length ? list : "",
      element("p", {}, more > 0 ? `${count(more, "more finding")}; ` : "", element("a", { href: check.page, target: "_blank", rel: "noopener" }, "map of the overlap and all findings")));
  }

  #progressPanel() {
    const { progress, stage, what, left_s } = this.task;
    const left = left_s > 0 ? `, ${roughly(left_s)} left` : "";
    return [
      element("progress", { max: 100, value: progress, "aria-label": `progress of ${this.task.name}` }),
      element("p", {}, `${Math.floor(progress)} %${left}${stage ? ` · ${stage}${what ? `: ${what}` : ""}` : ""}`),
    ];
  }

  #saidPanel() {
    const { message, hint } = this.task;
    return [
      message ? element("p", { class: "warning" }, message, hint ? ` ${hint}` : "") : "",
      this.said ? element("p", { class: "warning", role: "alert" }, this.said) : "",
    ];
  }

  #resultsPanel() {
    const link = (result) => element("a", {
      href: result.href, class: result.main ? "button" : "", ...(result.inside ? { target: "_blank", rel: "noopener" } : { download: true }),
    }, result.title);
    const main = this.task.results.filter((result) => result.main);
    const rest = this.task.results.filter((result) => !result.main);
    const buttons = main.map((result) => (result.bytes > 0 && !result.inside ? element("span", { class: "with-size" }, link(result), ` ${size(result.bytes)}`) : link(result)));
    if (!rest.length) return [element("div", { class: "row" }, ...buttons)];
    const rows = rest.map((result) => element("tr", {}, element("th", { scope: "row" }, link(result)), element("td", {}, size(result.bytes)), element("td", { class: "word" }, result.text)));
    const head = element("tr", {}, element("th", { scope: "col" }, "file"), element("th", { scope: "col" }, "size"), element("th", { scope: "col", class: "word" }, "what it is"));
    return [
      element("div", { class: "row" }, ...buttons),
      element("details", { class: "files" }, element("summary", {}, `All ${count(rest.length, "file")}`),
        element("div", { class: "scroll", role: "region", "aria-label": "files", tabindex: "0" }, element("table", {}, element("thead", {}, head), element("tbody", {}, ...rows)))),
    ];
  }

  #actions() {
    const { state, can = {} } = this.task;
    const row = [];
    if (state === "uploading") row.push(...this.#startActions());
    if (state === "waiting" || state === "running") row.push(button("Cancel", () => this.page.cancel(this)));
    if (can.watch) row.push(element("a", { class: "button", href: `view/${this.uuid}/live` }, "Watch the training"));
    if (can.mark) row.push(element("a", { class: "button", href: `view/${this.uuid}/mark` }, state === "marks" ? "Mark the control points" : "Mark control points"));
    if (state === "marks") row.push(button("Go on with the run", () => this.page.repeat(this, { pause: false }), "first"));
    if (can.marked) row.push(button("Apply the marks", () => this.page.repeat(this, { pause: false }), "first"));
    if (ENDED.includes(state) && this.repeating) {
      row.push(button("Run again", () => this.page.repeat(this, { form: true }), "first"), button("Leave it", () => this.#repeat(false)));
    } else if (ENDED.includes(state) && can.restart) {
      row.push(button(state === "done" ? "Run again with other options" : "Run again", () => this.#repeat(true)));
    }
    row.push(button("Remove", () => this.page.remove(this), "remove"));
    row.forEach((each, number) => (each.dataset.keep = `action${number}`));
    return [element("div", { class: "row" }, ...row)];
  }

  #startActions() {
    const { check, can = {} } = this.task;
    const pause = can.pause ? [this.#pauseBox()] : [];
    if (this.upload && !this.upload.complete) return [...pause, element("button", { type: "button", class: "first", disabled: true }, "Start")];
    const checked = check?.state === "done";
    const idle = ["none", "failed", undefined].includes(check?.state);
    const text = !checked ? "Start without the check" : check.verdict === "error" ? "Start all the same" : "Start";
    const again = idle ? [button("Check", () => this.page.check(this), "first")] : [];
    return [...pause, ...again, button(text, () => this.page.start(this), checked && check.verdict !== "error" ? "first" : "")];
  }

  #pauseBox() {
    this.pause ??= element("input", { type: "checkbox", id: `pause-${this.uuid}` });
    return element("span", { class: "pause" }, this.pause, element("label", { for: this.pause.id }, "Stop before the training, to mark control points"));
  }

  #repeat(on) {
    this.repeating = on;
    if (on) this.form_ = null;
    this.update(this.task);
    (on ? this.panels.form.querySelector("input") : this.heading)?.focus();
  }

  #logPanel() {
    this.log_ = element("details", { ontoggle: () => this.log_.open && this.#readLog() }, element("summary", {}, "Log"), element("pre", { tabindex: "0", "aria-label": "log" }, "…"));
    return [this.log_];
  }

  async #readLog() {
    if (this.reading) return;
    this.reading = true;
    try {
      const lines = await this.page.log(this, LOG_LINES);
      const pre = this.log_.querySelector("pre");
      const text = lines.join("\n") || "Nothing yet.";
      if (pre.textContent !== text) {
        const atEnd = pre.scrollHeight - pre.scrollTop - pre.clientHeight < 40 || pre.textContent === "…";
        pre.textContent = text;
        if (atEnd) pre.scrollTop = pre.scrollHeight;
      }
    } catch {
      // The next poll tries again, and says what is wrong with the node.
    } finally {
      this.reading = false;
    }
  }
}
