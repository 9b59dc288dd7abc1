// Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
// The colours of a field: blue below the target or 0, red above. As pdeloop/messages/colour_scale.py has
// them: ColorBrewer's RdBu (Apache-2.0), which any colour vision can read, and on a dark page a
// scale with a dark middle.

import { DARK } from "./format.js";

export const STOPS = {
  light: ["#053061", "#2166ac", "#4393c3", "#92c5de", "#d1e5f0", "#f7f7f7", "#fddbc7", "#f4a582", "#d6604d", "#b2182b", "#67001f"],
  dark: ["#a6d8ff", "#6fb3e8", "#3f86c0", "#285c88", "#1d3a55", "#1b1f26", "#4a2419", "#7d3520", "#b85a3a", "#e58a66", "#ffc9b0"],
};
const SIZE = 511;

const channels = (stop) => [1, 3, 5].map((i) => Number.parseInt(stop.slice(i, i + 2), 16));

// SIZE colours from the lowest value to the highest, each [red, green, blue].
function between(stops) {
  const given = stops.map(channels);
  return Array.from({ length: SIZE }, (_, i) => {
    const at = (i / (SIZE - 1)) * (stops.length - 1);
    const low = Math.min(Math.floor(at), stops.length - 2);
    return given[low].map((c, k) => Math.round(c + (at - low) * (given[low + 1][k] - c)));
  });
}

const TABLES = { light: between(STOPS.light), dark: between(STOPS.dark) };
const PIXELS = Object.fromEntries(
  Object.entries(TABLES).map(([name, table]) => [
    name,
    Uint32Array.from(table, ([r, g, b]) => ((255 << 24) | (b << 16) | (g << 8) | r) >>> 0),
  ]),
);
const scheme = () => (DARK.matches ? "dark" : "light");

// The colours as the pixels of an ImageData, from the lowest to the highest.
export const pixels = () => PIXELS[scheme()];

// The colour of a share of the range, from 0 to 1.
export function css(share) {
  const at = Math.max(0, Math.min(SIZE - 1, Math.round(share * (SIZE - 1))));
  return `rgb(${TABLES[scheme()][at].join(",")})`;
}
