// Numbers in words, as people read them.

export const count = (value, one, more = `${one}s`) => `${value.toLocaleString("en")} ${value === 1 ? one : more}`;

/** A size in bytes, with decimal prefixes. */
export function size(bytes) {
  if (!Number.isFinite(bytes)) return "–";
  const units = ["B", "kB", "MB", "GB", "TB"];
  const power = Math.min(units.length - 1, Math.max(0, Math.floor(Math.log10(Math.max(1, bytes)) / 3)));
  const value = bytes / 1000 ** power;
  return `${power === 0 || value >= 100 ? value.toFixed(0) : value.toFixed(1)} ${units[power]}`;
}

/** A duration, rounded as forecasts deserve. */
export function roughly(seconds) {
  if (!Number.isFinite(seconds)) return "–";
  if (seconds < 60) return "less than a minute";
  const minutes = Math.round(seconds / 60);
  if (minutes < 90) return `about ${count(minutes, "minute")}`;
  const hours = seconds / 3600;
  if (hours < 36) return `about ${hours < 9.5 ? hours.toFixed(1) : hours.toFixed(0)} hours`;
  return `about ${count(Math.round(hours / 24), "day")}`;
}

/** A point in time in the reader's own zone. */
export function moment(milliseconds) {
  if (!Number.isFinite(milliseconds)) return "";
  const when = new Date(milliseconds);
  const sameDay = when.toDateString() === new Date().toDateString();
  const time = when.toLocaleTimeString([], { hour: "2-digit", minute: "2-digit" });
  return sameDay ? `today ${time}` : `${when.toLocaleDateString([], { day: "numeric", month: "short", year: "numeric" })} ${time}`;
}

/** Some names, and how many more there are. */
export function listed(names, most = 5) {
  const shown = names.slice(0, most).join(", ");
  return names.length > most ? `${shown} and ${(names.length - most).toLocaleString("en")} more` : shown;
}
