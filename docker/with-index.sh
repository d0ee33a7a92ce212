#!/bin/sh
# Runs a command of the image's build with the certificates of a private package index, if they are given as a secret.
[ ! -e /run/secrets/cert ] || export PIP_CERT=/run/secrets/cert NODE_EXTRA_CA_CERTS=/run/secrets/cert
exec "$@"
