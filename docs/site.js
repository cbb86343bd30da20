// Search of the site without a server. Browsers start no worker from file://, so a hidden frame runs its script.
if (location.protocol === "file:") {
  // A worker gets copies. Without them, the page would clear the search field when results arrive.
  const messageOf = (data) => new MessageEvent("message", { data: structuredClone(data) });
  window.Worker = class extends EventTarget {
    constructor(url) {
      super();
      const frame = document.body.appendChild(Object.assign(document.createElement("iframe"), { hidden: true }));
      const inside = frame.contentWindow;
      inside.postMessage = (data) => {
        const event = messageOf(data);
        this.dispatchEvent(event);
        this.onmessage?.(event);
      };
      const script = Object.assign(inside.document.createElement("script"), { src: url });
      const loaded = new Promise((done) => { script.onload = done; });
      this.postMessage = (data) => loaded.then(() => inside.dispatchEvent(messageOf(data)));
      inside.document.body.append(script);
    }
    terminate() {}
  };
}
