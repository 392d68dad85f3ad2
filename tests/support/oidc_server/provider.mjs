// A provider of OpenID Connect that is certified by the OpenID Foundation: oidc-provider, with accounts from the
// command line. Its ID tokens hold what the standard demands and no more; names and groups come from userinfo.
import { createServer } from 'node:http'
import Provider from 'oidc-provider'

const [accounts, secret, callback] = [JSON.parse(process.argv[2]), process.argv[3], process.argv[4]]
const server = createServer()
server.listen(0, '127.0.0.1', () => {
  const issuer = `http://127.0.0.1:${server.address().port}`
  const provider = new Provider(issuer, {
    clients: [{ client_id: 'servoscope', client_secret: secret, redirect_uris: [callback] }],
    claims: { openid: ['sub'], profile: ['preferred_username', 'groups'] },
    cookies: { keys: ['of the tests'] },
    findAccount: (_, id) => {
      const found = accounts.find((one) => one.sub === id)
      return found && { accountId: id, claims: async () => found }
    },
  })
  server.on('request', provider.callback())
  console.log(issuer)
})
