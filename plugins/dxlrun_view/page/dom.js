// Helpers to draw the page.
export const $ = (id) => document.getElementById(id);

export function make(tag, properties = {}, ...children) {
  const element = Object.assign(document.createElement(tag), properties);
  element.append(...children);
  return element;
}

// Return true if what an element shows is another than at the last call, so that it must be built again.
export function isNew(element, ...shown) {
  const key = JSON.stringify(shown);
  if (element.shownKey === key) return false;
  element.shownKey = key;
  return true;
}

export function setText(element, text) {
  if (element.textContent !== text) element.textContent = text;
}
