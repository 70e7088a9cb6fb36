// Filters of the gallery: shows each grid as figures, and menus above the first one that hide what is not asked for.
document.addEventListener("DOMContentLoaded", () => {
  const figures = [];
  for (const table of document.querySelectorAll("article table")) {
    const cells = [...table.querySelectorAll("td")].filter((cell) => cell.querySelector('img[src*="gallery/"]'));
    if (!cells.length) continue;
    let heading = table.closest(".md-typeset__scrollwrap") || table;
    const outer = heading;
    while (heading && heading.tagName !== "H2") heading = heading.previousElementSibling;
    const grid = document.createElement("div");
    grid.className = "gallery";
    for (const cell of cells) {
      const [task, result, robot] = cell.innerText.trim().split("\n").map((line) => line.trim());
      const figure = document.createElement("figure");
      figure.append(...cell.childNodes);
      grid.append(figure);
      const named = [...document.querySelectorAll("article li > strong")].find((name) => name.textContent === task);
      figures.push({
        task, robot, status: result.split(",")[0], suite: heading.firstChild.textContent, heading,
        parts: [figure, named && named.parentElement].filter(Boolean),
      });
    }
    outer.replaceWith(grid);
  }
  if (!figures.length) return;
  const form = document.createElement("form");
  form.className = "gallery-filters";
  const count = document.createElement("output");
  const menus = ["suite", "robot", "status"].map((key) => {
    const menu = document.createElement("select");
    menu.name = key;
    menu.setAttribute("aria-label", key);
    const values = [...new Set(figures.map((entry) => entry[key]).filter(Boolean))].sort();
    menu.append(new Option(`any ${key}`, ""), ...values.map((value) => new Option(value, value)));
    form.append(menu);
    return menu;
  });
  form.append(count);
  const filter = () => {
    const shown = figures.filter((entry) => menus.every((menu) => !menu.value || entry[menu.name] === menu.value));
    for (const entry of figures) {
      for (const part of entry.parts) part.hidden = !shown.includes(entry);
      entry.heading.hidden = !shown.some((other) => other.suite === entry.suite);
    }
    count.value = `${shown.length} of ${figures.length} tasks`;
  };
  form.addEventListener("change", filter);
  filter();
  document.querySelector("article h2").before(form);
});
