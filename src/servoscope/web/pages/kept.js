// What was typed into named fields stays over a reload and a way back, in this tab.

// Puts back what was typed before under this name, but for what the address says; and takes note from now on.
export function kept(name, element) {
  const typed = read(name);
  const said = new URLSearchParams(location.search);
  for (const field of element.querySelectorAll("[name]")) {
    const value = typed[field.name];
    if (value === undefined || said.has(field.name)) continue;
    if (field.options && ![...field.options].some((option) => option.value === value)) continue; // there is no such choice any more
    field.value = value;
    for (const kind of ["input", "change"]) field.dispatchEvent(new Event(kind)); // it counts as typed
  }
  element.addEventListener("input", ({ target }) => {
    typed[target.name] = target.value;
    keep(name, typed);
  });
}

// Keeps what fields of these names shall hold, on this page or on the next.
export function keep(name, typed) {
  try {
    sessionStorage.setItem(name, JSON.stringify(typed));
  } catch {
    // storage may be forbidden, or full: it holds until the page is left
  }
}

function read(name) {
  try {
    return JSON.parse(sessionStorage.getItem(name)) ?? {};
  } catch {
    return {};
  }
}
