// A button in the element `theme` that changes between light and dark; the choice is kept where that is possible.
(() => {
  "use strict";
  const root = document.documentElement, place = document.getElementById("theme");
  const dark = matchMedia("(prefers-color-scheme: dark)");
  const now = () => root.dataset.theme || (dark.matches ? "dark" : "light");
  const button = document.createElement("button");
  const label = () => { button.textContent = now() === "dark" ? "light colours" : "dark colours"; };
  try {
    const kept = localStorage.getItem("tlf-theme");
    if (kept === "dark" || kept === "light") root.dataset.theme = kept;
  } catch { /* no storage */ }
  button.type = "button";
  button.addEventListener("click", () => {
    root.dataset.theme = now() === "dark" ? "light" : "dark";
    try { localStorage.setItem("tlf-theme", root.dataset.theme); } catch { /* no storage */ }
    label();
    dispatchEvent(new Event("theme"));
  });
  dark.addEventListener("change", label);
  label();
  if (place) place.append(button);
})();
