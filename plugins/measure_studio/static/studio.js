// Pictures marked data-live are fetched again as soon as the last one is there, four times a second
// at most, and only while they can be seen.
const period = 250;

async function refresh() {
  const shown = [...document.querySelectorAll("img[data-live]")].filter(
    (image) => image.offsetParent !== null && !image.dataset.waits,
  );
  if (document.hidden) return;
  for (const image of shown) {
    image.dataset.waits = "yes";
    try {
      const answer = await fetch(image.dataset.live);
      if (answer.status === 200) {
        const old = image.src, next = new Image();
        next.src = URL.createObjectURL(await answer.blob());
        await next.decode(); // Or it had no size for a moment, and a click into it would be lost.
        image.src = next.src;
        if (old.startsWith("blob:")) URL.revokeObjectURL(old);
      }
      image.classList.toggle("missing", answer.status !== 200);
    } catch {
      image.classList.add("missing");
    } finally {
      delete image.dataset.waits;
    }
  }
}

setInterval(refresh, period);

// What is shown is old once the server is gone: nothing looks live then.
setInterval(() => document.body.classList.toggle("lost", window.socket?.connected === false), period);

// Quasar gives up after 50 ms to place a menu that has no size yet, as on a busy computer, and leaves
// it hidden for good: it is put below its field here, or above where there is more room.
function placeMenus() {
  for (const menu of document.querySelectorAll(".q-menu")) {
    const field = document.querySelector(`[aria-controls="${menu.id}"]`)?.closest(".q-field");
    if (!field || menu.style.visibility || !menu.offsetHeight) continue;
    const box = field.getBoundingClientRect(), below = innerHeight - box.bottom;
    const above = menu.offsetHeight > below && box.top > below;
    const room = above ? box.top : below, height = Math.min(menu.offsetHeight, room);
    menu.style.top = `${above ? box.top - height : box.bottom}px`;
    menu.style.left = `${box.left}px`;
    menu.style.minWidth = `${box.width}px`;
    menu.style.maxHeight = `${room}px`;
    menu.style.visibility = "visible";
  }
}

setInterval(placeMenus, period);

// Pictures marked `marked` are shown enlarged about the pointer, with the marks where they were
// refined to. A pixel's centre is at integers; canvas and overlay count from the picture's corner.
const across = 33;
let pointer = null;

document.addEventListener("pointermove", (event) => {
  const shown = event.target.closest?.(".marked");
  if (shown) {
    const image = shown.querySelector("img"), box = image.getBoundingClientRect();
    const scale = image.naturalWidth / box.width;
    pointer = { shown, u: (event.clientX - box.left) * scale, v: (event.clientY - box.top) * scale };
    magnify();
  }
});

function magnify() {
  const canvas = document.querySelector("canvas.magnifier");
  if (!canvas || !pointer?.shown.isConnected) return;
  const context = canvas.getContext("2d"), zoom = canvas.width / across;
  const left = Math.floor(pointer.u) - (across - 1) / 2, top = Math.floor(pointer.v) - (across - 1) / 2;
  context.imageSmoothingEnabled = false;
  context.clearRect(0, 0, canvas.width, canvas.height);
  context.drawImage(pointer.shown.querySelector("img"), left, top, across, across, 0, 0, canvas.width, canvas.height);
  for (const mark of pointer.shown.querySelectorAll("circle.mark")) {
    const [u, v, radius] = ["cx", "cy", "r"].map((name) => zoom * Number(mark.getAttribute(name)));
    stroke(context, getComputedStyle(mark).stroke, u - zoom * left, v - zoom * top, radius);
  }
  stroke(context, "#ffffff", zoom * (pointer.u - left), zoom * (pointer.v - top), 0);
}

function stroke(context, color, x, y, radius) {
  context.strokeStyle = color;
  context.beginPath();
  if (radius) context.arc(x, y, radius, 0, 2 * Math.PI);
  for (const [a, b] of [[9, 0], [0, 9]]) {
    context.moveTo(x - a, y - b);
    context.lineTo(x + a, y + b);
  }
  context.stroke();
}

setInterval(magnify, period);

// Where a picture was clicked, as shares of its width and height: it may have bars beside it.
window.sharesOf = ({ target: image, clientX, clientY }) => {
  const box = image.getBoundingClientRect();
  const scale = Math.min(box.width / image.naturalWidth, box.height / image.naturalHeight);
  return [
    0.5 + (clientX - box.left - box.width / 2) / (scale * image.naturalWidth),
    0.5 + (clientY - box.top - box.height / 2) / (scale * image.naturalHeight),
  ];
};

// Space stops what goes on, or begins what the page is for: on the button that began it, too.
document.addEventListener("keydown", (event) => {
  const typed = "input, textarea, select, button:not([data-begin]), a, summary";
  if (event.key !== " " || event.repeat || event.target.closest(typed)) return;
  const shown = [...document.querySelectorAll(".foot .stop, [data-begin]")].filter((one) => one.offsetParent);
  const meant = shown.find((one) => one.matches(".stop")) ?? shown[0];
  if (!meant) return;
  event.preventDefault();
  event.stopPropagation();
  meant.click();
}, true);
