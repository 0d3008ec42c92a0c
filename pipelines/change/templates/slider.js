// Pictures of two epochs over each other: the slider tells how much the earlier one covers, by mouse and by keys.
for (const figure of document.querySelectorAll(".compare")) {
  const slider = figure.querySelector("input");
  const show = () => {
    figure.style.setProperty("--at", `${slider.value}%`);
    slider.setAttribute("aria-valuetext", `${slider.value} % ${slider.dataset.before}`);
  };
  slider.addEventListener("input", show);
  figure.classList.add("live");
  show();
}
