// Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
// Colours of the page's style, and numbers as a person writes them.

export const DARK = matchMedia("(prefers-color-scheme: dark)");

const probe = document.head.appendChild(document.createElement("i"));

// A colour of the style sheet, as a canvas takes it; the accent where it has none of this name.
export function colour(name) {
  probe.style.color = `var(--${name}, var(--accent))`;
  return getComputedStyle(probe).color;
}

// With as many digits as a step of this size needs.
export function text(value, step = 0) {
  if (value === null || value === undefined || !Number.isFinite(value)) return "–";
  const size = Math.abs(value);
  if (size >= 1e6 || (size > 0 && size < 1e-3)) {
    return value.toExponential(1).replace("e+", "e").replace(".0e", "e").replace("-", "−");
  }
  const digits = step ? Math.max(0, -Math.floor(Math.log10(step) + 1e-9)) : null;
  const words = digits === null ? String(Number(value.toPrecision(4))) : value.toFixed(digits);
  return Number(words) === 0 ? words.replace("-", "") : words.replace("-", "−"); // no "−0.0"
}

// A span of time in its largest unit, or in two while the larger one is small.
export function duration(seconds) {
  if (seconds < 60) return `${Math.round(seconds)} s`;
  const minutes = Math.round(seconds / 60);
  if (minutes < 60) return `${minutes} min`;
  return `${Math.floor(minutes / 60)} h ${minutes % 60} min`;
}
