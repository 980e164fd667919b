// Dragging, or the arrow keys, rotate the picture of the path; without this script it is a static picture.
for (const svg of document.querySelectorAll("svg.spatial")) {
  const radians = Math.PI / 180;
  const first = { azimuth: Number(svg.dataset.azimuth), elevation: Number(svg.dataset.elevation), zoom: 1 };
  const view = { ...first };
  const [width, height] = [svg.viewBox.baseVal.width, svg.viewBox.baseVal.height];
  const numbers = (element) => element.dataset.points.split(" ").filter(Boolean).map((mm) => Number(mm) / 1000);
  const paths = [...svg.querySelectorAll("path")].map((element) => [element, numbers(element), "pairs" in element.dataset]);
  const marks = [...svg.querySelectorAll("text")].map((element) => [element, numbers(element)]);
  const draw = () => {
    const [a, e] = [view.azimuth * radians, view.elevation * radians];
    const right = [-Math.sin(a), Math.cos(a), 0];
    const down = [Math.sin(e) * Math.cos(a), Math.sin(e) * Math.sin(a), -Math.cos(e)];
    const along = (axis, p, i) => axis[0] * p[i] + axis[1] * p[i + 1] + axis[2] * p[i + 2];
    for (const [element, p, pairs] of paths) {
      const words = [];
      for (let i = 0; i < p.length; i += 3) {
        const begins = i === 0 || (pairs && i % 6 === 0);
        words.push(`${begins ? "M" : "L"}${along(right, p, i).toFixed(3)} ${along(down, p, i).toFixed(3)}`);
      }
      element.setAttribute("d", words.join(""));
    }
    for (const [element, p] of marks) {
      element.setAttribute("x", along(right, p, 0).toFixed(3));
      element.setAttribute("y", along(down, p, 0).toFixed(3));
    }
    const [w, h] = [width / view.zoom, height / view.zoom];
    svg.setAttribute("viewBox", `${-w / 2} ${-h / 2} ${w} ${h}`);
  };
  const turn = (azimuth, elevation, zoom) => {
    view.azimuth += azimuth;
    view.elevation = Math.min(90, Math.max(-90, view.elevation + elevation));
    view.zoom = Math.min(8, Math.max(0.25, view.zoom * zoom));
    draw();
  };
  const keys = {
    ArrowLeft: [-5, 0, 1], ArrowRight: [5, 0, 1], ArrowUp: [0, 5, 1], ArrowDown: [0, -5, 1],
    "+": [0, 0, 1.2], "-": [0, 0, 1 / 1.2],
  };
  const reset = () => { Object.assign(view, first); draw(); };
  svg.addEventListener("keydown", (event) => {
    if (event.key === "Home") reset();
    else if (keys[event.key]) turn(...keys[event.key]);
    else return;
    event.preventDefault();
  });
  svg.addEventListener("pointerdown", (event) => svg.setPointerCapture(event.pointerId));
  svg.addEventListener("pointermove", (event) => {
    if (event.buttons) turn(-0.5 * event.movementX, 0.5 * event.movementY, 1);
  });
  svg.addEventListener("wheel", (event) => {
    if (!event.ctrlKey) return; // the wheel alone scrolls the page
    event.preventDefault();
    turn(0, 0, Math.exp(-0.002 * event.deltaY));
  }, { passive: false });
  svg.addEventListener("dblclick", reset);
  svg.setAttribute("tabindex", "0");
  for (const hint of svg.parentElement.querySelectorAll("[hidden]")) hint.hidden = false;
}
