// From the world's metres to the run's CRS, by the polynomial that pipeline/survey/crs/local_crs.py fitted to PROJ.

/**
 * @param {{origin: number[], scale_m: number, powers: number[][], coefficients: number[][]}} crs
 * @param {number[]} point East, north, up in metres.
 * @returns {number[]} Easting (longitude), northing (latitude), height.
 */
export function toCrs(crs, point) {
  const steps = point.map((value) => value / crs.scale_m);
  const result = [...crs.origin];
  crs.powers.forEach((powers, term) => {
    const product = powers.reduce((value, power, axis) => value * steps[axis] ** power, 1);
    for (let axis = 0; axis < 3; axis++) result[axis] += product * crs.coefficients[term][axis];
  });
  return result;
}

/** Coordinates for people: [label, value] for each axis. */
export function coordinateLabels(facts, point) {
  if (!facts.crs) {
    const digits = facts.metres ? 2 : 3;
    return ["x", "y", "z"].map((label, axis) => [label, point[axis].toFixed(digits)]);
  }
  const values = toCrs(facts.crs, point);
  const digits = facts.crs.geographic ? [8, 8, 2] : [2, 2, 2];
  return facts.crs.labels.map((label, axis) => [label, values[axis].toFixed(digits[axis])]);
}
