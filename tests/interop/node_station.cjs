// A ground station on node-mavlink: connects, decodes the stream, fetches the parameters, tells it as lines of JSON.
// Arguments: node_modules, TCP port, layout of our messages as JSON.
'use strict'
const net = require('net')
const { createRequire } = require('module')
const [, , modules, port, layouts] = process.argv
const from = createRequire(modules + '/')
const mavlink = from('node-mavlink')
const { MavLinkPacketField, MavLinkData } = from('mavlink-mappings')

const registry = { ...mavlink.minimal.REGISTRY, ...mavlink.common.REGISTRY }
for (const layout of JSON.parse(layouts)) {
  class Ours extends MavLinkData {}
  Ours.MSG_ID = layout.id
  Ours.MSG_NAME = layout.name
  Ours.PAYLOAD_LENGTH = layout.size
  Ours.MAGIC_NUMBER = layout.extra
  Ours.FIELDS = layout.fields.map(f => new MavLinkPacketField(f.name, f.name, f.offset, false, f.size, f.type, ''))
  registry[layout.id] = Ours
  mavlink.registerCustomMessageMagicNumber(String(layout.id), layout.extra)
}
const plain = (_, value) => (typeof value === 'bigint' ? Number(value) : value)
const tell = (name, what) => console.log(JSON.stringify({ [name]: what }, plain).replace(/^\{"([^"]*)":/, '{"$1": '))

const counts = {}, latest = {}, parameters = {}
let total = -1, bad = 0, told = false
const socket = net.connect(Number(port), '127.0.0.1', () => {
  const stream = mavlink.createMavLinkStream(socket, { onCrcError: () => { bad += 1 } })
  stream.on('data', packet => {
    const kind = registry[packet.header.msgid]
    if (!kind) return
    const data = packet.protocol.data(packet.payload, kind)
    counts[kind.MSG_NAME] = (counts[kind.MSG_NAME] || 0) + 1
    latest[kind.MSG_NAME] = { ...data, from: [packet.header.sysid, packet.header.compid] }
    if (kind.MSG_NAME === 'PARAM_VALUE') {
      parameters[data.paramId] = data.paramValue
      total = data.paramCount
    }
    const speaks = latest.MAG_STATUS?.sensor_state === 1 // it may be silent for a moment where the machine stands still
    if (!told && speaks && Object.keys(parameters).length === total && counts.MAG_FIELD > 50 && counts.HEARTBEAT) {
      told = true
      tell('result', { counts, latest, parameters, bad })
    }
  })
  const ask = new mavlink.common.ParamRequestList()
  ask.targetSystem = 1
  ask.targetComponent = 191
  mavlink.send(socket, ask, new mavlink.MavLinkProtocolV2())
})
process.stdin.on('end', () => process.exit(0))
process.stdin.resume()
