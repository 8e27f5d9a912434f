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
        const old = image.src;
        image.src = URL.createObjectURL(await answer.blob());
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
