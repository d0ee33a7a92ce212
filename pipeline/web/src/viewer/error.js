// An error that prevents a model from being shown, with a message for people.

export class LoadError extends Error {
  /** @param {string} message What is wrong. @param {string} hint What to do about it. */
  constructor(message, hint) {
    super(message);
    this.hint = hint;
  }
}
