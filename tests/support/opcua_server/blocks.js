// An OPC UA server of another stack whose assets write blocks as a PLC would; tests/support/reliability/plc.py is its twin.
//
//     node tests/support/opcua_server/blocks.js SETTINGS
"use strict";
const fs = require("node:fs");
const opcua = require("node-opcua");

function cells(settings, number) {
  const [t, ...signals] = settings.blocks[number % settings.blocks.length];
  const start = settings.first + Math.floor(number / settings.blocks.length) * settings.round_s;
  return Float64Array.from([number, ...t.map((x) => start + x), ...signals.flat()]);
}

async function main(settings) {
  const server = new opcua.OPCUAServer({ port: settings.port, hostname: "127.0.0.1", resourcePath: "/plc" });
  await server.initialize();
  const space = server.engine.addressSpace;
  const type = { dataType: opcua.DataType.Double, arrayType: opcua.VariantArrayType.Array };
  const nodes = {};
  for (const [name, nodeId] of Object.entries(settings.nodes)) {
    const node = { organizedBy: space.rootFolder.objects, browseName: name, nodeId, dataType: "Double", valueRank: 1, minimumSamplingInterval: 10 };
    nodes[name] = space.getOwnNamespace().addVariable({ ...node, value: new opcua.Variant({ ...type, value: new Float64Array(1) }) });
    space.installHistoricalDataNode(nodes[name], { maxOnlineValues: settings.remembered });
  }
  const notes = fs.openSync(settings.written, "a");
  let number = Math.floor((Date.now() / 1000 - settings.began) / settings.every_s);
  function next() {
    number += 1;
    setTimeout(write, Math.max(0, 1000 * (settings.began + number * settings.every_s) - Date.now()));
  }
  function write() {
    const block = cells(settings, number);
    const stamp = new Date(1000 * block[(block.length - 1) / 4]); // of the last sample
    for (const [name, node] of Object.entries(nodes)) {
      fs.writeSync(notes, `${name} ${number}\n`);
      node.setValueFromSource(new opcua.Variant({ ...type, value: block }), opcua.StatusCodes.Good, stamp);
    }
    next();
  }
  await server.start();
  console.log("ready");
  next();
}

main(JSON.parse(fs.readFileSync(process.argv[2], "utf-8")));
