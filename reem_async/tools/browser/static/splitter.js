// The edge between the keys and the value, which can be dragged, or moved with the arrow keys.
import { store, stored } from "./util.js";

const NAME = "reem:split", LEAST = 20, MOST = 75, STEP = 2; // percent of the width

export function makeSplitter(main, edge) {
  const show = (percent) => {
    const share = Math.min(Math.max(percent, LEAST), MOST);
    main.style.setProperty("--tree", `${share}%`);
    edge.setAttribute("aria-valuenow", String(Math.round(share)));
    return share;
  };
  let share = show(stored(NAME, 40));
  const move = (percent) => { share = show(percent); store(NAME, share); };
  edge.addEventListener("pointerdown", (event) => { edge.setPointerCapture(event.pointerId); event.preventDefault(); edge.focus(); });
  edge.addEventListener("pointermove", (event) => {
    if (!edge.hasPointerCapture(event.pointerId)) return;
    const box = main.getBoundingClientRect();
    move(((event.clientX - box.left) / box.width) * 100);
  });
  edge.addEventListener("dblclick", () => move(40));
  edge.addEventListener("keydown", (event) => {
    const step = { ArrowLeft: -STEP, ArrowRight: STEP }[event.key];
    if (!step) return;
    move(share + step);
    event.preventDefault();
    event.stopPropagation();
  });
}
