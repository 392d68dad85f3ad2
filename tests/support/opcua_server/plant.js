// An OPC UA server of another stack, as a process of its own: what it grants is less than it is asked for.
//
//     node tests/support/opcua_server/plant.js PORT RATE [CERTIFICATES]
//
// Sample k, at RATE, holds r = 5, u = sin(k / 7), y = cos(k / 9), temperature = floor(k / 20), each stamped by the server. `press.*` may be sampled every 50 ms at
// best (its MinimumSamplingInterval), `lift.*` as fast as asked. With a folder CERTIFICATES only clients it knows are let in.
"use strict";
const opcua = require("node-opcua");

async function main(port, rate, folder) {
  const security = folder && {
    securityModes: [opcua.MessageSecurityMode.SignAndEncrypt],
    securityPolicies: [opcua.SecurityPolicy.Basic256Sha256],
    serverCertificateManager: new opcua.OPCUACertificateManager({ rootFolder: folder, automaticallyAcceptUnknownCertificate: false }),
  };
  const server = new opcua.OPCUAServer({ port, hostname: "127.0.0.1", resourcePath: "/plant", ...security });
  await server.initialize();
  const space = server.engine.addressSpace.getOwnNamespace();
  const values = { r: 5, u: 0, y: 1, temperature: 0 };
  const nodes = [];
  for (const [machine, minimumSamplingInterval] of [["press", 50], ["lift", 1]]) {
    for (const name of Object.keys(values)) {
      const nodeId = `ns=1;s=${machine}.${name}`;
      const node = space.addVariable({ organizedBy: server.engine.addressSpace.rootFolder.objects, browseName: nodeId, nodeId, dataType: "Double", minimumSamplingInterval });
      nodes.push([node, name]);
    }
  }
  let k = 0;
  setInterval(() => {
    k += 1;
    Object.assign(values, { u: Math.sin(k / 7), y: Math.cos(k / 9), temperature: Math.floor(k / 20) });
    for (const [node, name] of nodes) node.setValueFromSource({ dataType: "Double", value: values[name] });
  }, 1000 / rate);
  await server.start();
  console.log("ready");
}

main(Number(process.argv[2]), Number(process.argv[3]), process.argv[4]);
