#!/bin/sh
# Makes what a secured server and its robots need: an authority, certificates, passwords, an ACL file.
#
#   deploy/prepare.sh [-n NAMESPACE] [-o DIRECTORY] HOST [HOST ...]
#
# HOST: the names and addresses by which robots reach the server. NAMESPACE: what RedisInterface(namespace=...)
# is given ("robot1:"; "" opens the whole server to both users). Run it on a machine that you trust; nothing
# is overwritten. Robots get ca.crt, robot.crt, robot.key and a password, the server the files that
# secured.conf names, and ca.key stays where nobody gets at it.
set -eu
umask 077
here=$(cd "$(dirname "$0")" && pwd)
out=$here/secrets
namespace=robot1:
while getopts n:o: option; do
    case $option in
        n) namespace=$OPTARG ;;
        o) out=$OPTARG ;;
        *) exit 2 ;;
    esac
done
shift $((OPTIND - 1))
[ $# -gt 0 ] || { echo "usage: $0 [-n NAMESPACE] [-o DIRECTORY] HOST [HOST ...]" >&2; exit 2; }
case $namespace in
    *[!A-Za-z0-9:_.-]*) echo "$0: a namespace for an ACL has letters, digits and : _ . - only" >&2; exit 2 ;;
    *[A-Za-z0-9]) echo "$0: a namespace ends with a separator; write $namespace:" >&2; exit 2 ;;
esac
if [ -e "$out/ca.key" ]; then
    echo "$0: $out is there already; remove it to begin anew (all robots need the new files then)" >&2
    exit 1
fi
mkdir -p "$out"
printf '*\n' > "$out/.gitignore"
cd "$out"
trap '[ ! -e openssl.log ] || cat openssl.log >&2' EXIT

names=
for host in "$@"; do
    case $host in
        *:* | *[0-9].[0-9]*.[0-9]*.[0-9]*) names=$names${names:+,}IP:$host ;;
        *) names=$names${names:+,}DNS:$host ;;
    esac
done

new_key="-newkey ec -pkeyopt ec_paramgen_curve:prime256v1 -nodes"
# shellcheck disable=SC2086
openssl req -x509 $new_key -days 3650 -subj "/CN=authority of a robot with REEM" -keyout ca.key -out ca.crt \
    -addext "keyUsage=critical,keyCertSign,cRLSign" 2> openssl.log

issue() { # name, extensions: a certificate for two years and three months
    # shellcheck disable=SC2086
    openssl req $new_key -subj "/CN=$1" -keyout "$1.key" -out "$1.csr" 2>> openssl.log
    printf '%s\n' "basicConstraints=CA:FALSE" "$2" > "$1.ext"
    openssl x509 -req -in "$1.csr" -CA ca.crt -CAkey ca.key -CAcreateserial -days 825 -extfile "$1.ext" \
        -out "$1.crt" 2>> openssl.log
    rm "$1.csr" "$1.ext"
}
# The server's certificate serves its own health check too.
issue server "subjectAltName=$names
extendedKeyUsage=serverAuth,clientAuth"
issue robot "extendedKeyUsage=clientAuth"

if [ -n "$namespace" ]; then
    sed "s/robot1:/$namespace/g" "$here/users.acl" > users.acl
else
    sed 's/~robot1:\* ~{robot1:\*/~*/; s/robot1://' "$here/users.acl" > users.acl
fi
for user in admin robot watcher; do
    openssl rand -hex 24 | tr -d '\n' > "$user.password"
    hash=$(openssl dgst -sha256 -r < "$user.password" | cut -c 1-64)
    sed "s/^user $user on resetpass/& #$hash/" users.acl > users.new
    mv users.new users.acl
done
# Read inside of a container by its own user; outside, the directory is closed to others.
chmod 644 ca.crt server.crt server.key users.acl
rm -f openssl.log
echo "made $out: authority, certificates, users.acl, and the passwords of admin, robot and watcher"
