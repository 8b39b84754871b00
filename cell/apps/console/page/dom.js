// Small helpers: elements, texts that change seldom, quantities as people read them.

export const byId = (id) => document.getElementById(id);

// An element with properties (dataset and aria-… as attributes) and children.
export function el(tag, properties = {}, ...children) {
  const made = document.createElement(tag);
  for (const [name, value] of Object.entries(properties)) {
    if (name.includes('-')) made.setAttribute(name, value);
    else made[name] = value;
  }
  made.append(...children);
  return made;
}

// Set a text, only where it differs: what did not change is neither drawn nor read aloud again.
export function say(node, text) {
  if (node.textContent !== text) node.textContent = text;
}

export function show(node, visible) {
  if (node.hidden === visible) node.hidden = !visible;
}

// Build children anew only when what they are made from has changed.
export function remake(node, key, make) {
  const text = JSON.stringify(key);
  if (node.made === text) return;
  node.made = text;
  node.replaceChildren(...make());
}

export const words = (name) => String(name ?? '').replaceAll('_', ' ');
export const mm = (metres, digits = 1) => `${(1e3 * metres).toFixed(digits)} mm`;
// An error in mm with the digits that count: 0.02, and 0.004.
export const figure = (value) => value.toFixed(value < 0.0095 ? 3 : 2);
export const deg = (radians, digits = 1) => `${(radians * 180 / Math.PI).toFixed(digits)}°`;

export function seconds(value) {
  if (value === null || value === undefined) return '';
  if (value < 90) return `${Math.round(value)} s`;
  return `${Math.floor(value / 60)} min ${String(Math.round(value % 60)).padStart(2, '0')} s`;
}

export const quantity = (value, unit) => (unit === 'rad' ? `${+(value * 180 / Math.PI).toFixed(3)}°` : `${+(1e3 * value).toFixed(3)} mm`);
