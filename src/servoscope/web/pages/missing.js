// An address that belongs to no page.
import { h } from "./dom.js";

export async function show(main) {
  main.replaceChildren(h("h1", {}, "No such page"), h("p", {}, location.pathname.startsWith("/help/") ? "This installation has no documentation: make docs builds it. " : "Nothing is at this address. ", h("a", { href: "/" }, "Go to the fleet")));
}
