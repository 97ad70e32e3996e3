// A gamepad as keys of the page, which viser passes on; a browser shows gamepads to scripts only.
if (!window.studioGamepad) {
  const STICK = 0.35; // from which a stick counts as moved
  const STICKS = [["j", "l"], ["i", "k"], ["n", "m"], ["u", "o"]]; // axis: keys of its two directions
  const BUTTONS = { 0: " ", 1: "z", 2: "x", 3: "Enter" };
  const press = (key) => {
    const code = { " ": "Space", Enter: "Enter" }[key] ?? "Key" + key.toUpperCase();
    document.documentElement.dispatchEvent(new KeyboardEvent("keydown", { key, code, bubbles: true }));
  };
  let held = new Set();
  window.studioGamepad = setInterval(() => {
    const down = new Set();
    for (const pad of navigator.getGamepads()) {
      if (!pad) continue;
      STICKS.forEach((keys, axis) => {
        const value = pad.axes[axis] ?? 0;
        if (Math.abs(value) > STICK) press(keys[value > 0 ? 1 : 0]);
      });
      for (const [button, key] of Object.entries(BUTTONS)) if (pad.buttons[button]?.pressed) down.add(key);
    }
    for (const key of down) if (!held.has(key)) press(key);
    held = down;
  }, 33);
}
