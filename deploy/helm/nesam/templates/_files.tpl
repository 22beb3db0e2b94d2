{{/* Configuration of the replicas; deploy/config/default.toml explains the keys. */}}
{{- define "nesam.toml" -}}
[grpc]
listen = "0.0.0.0:50051"

[http]
listen = "0.0.0.0:50080"

[zenoh]
enabled = {{ .Values.zenoh.enabled }}
{{- if .Values.zenoh.enabled }}
mode = {{ ternary "peer" "client" .Values.zenoh.listen | quote }}
listen = {{ ternary (list "tcp/0.0.0.0:7447") list .Values.zenoh.listen | toJson }}
connect = {{ .Values.zenoh.connect | toJson }}
fleet = {{ .Values.zenoh.fleet | quote }}
{{- end }}
{{- if .Values.tls.secret }}

[tls]
certificate = "/etc/nesam/tls/tls.crt"
key = "/etc/nesam/tls/tls.key"
{{- end }}

[cluster]
etcd = {{ .Values.etcd.endpoints | toJson }}
prefix = {{ .Values.etcd.prefix | quote }}
lease_s = {{ .Values.etcd.leaseSeconds | int }}
{{- if .Values.etcd.tlsSecret }}
certificate = "/etc/nesam/etcd/tls.crt"
key = "/etc/nesam/etcd/tls.key"
authority = "/etc/nesam/etcd/ca.crt"
{{- end }}
{{- with .Values.config }}

{{ . | trim }}
{{- end }}
{{- end }}

{{/* Configuration of the proxy: deploy/haproxy/haproxy.cfg for this release. That file says why. */}}
{{- define "nesam.haproxy" -}}
{{- $name := include "nesam.name" . -}}
global
    maxconn {{ .Values.proxy.maxConnections | int }}
    nbthread {{ .Values.proxy.threads | int }}
    hard-stop-after 20s
    log stdout format raw local0 info
    {{- if .Values.proxy.tlsSecret }}
    # tls.key beside tls.crt.
    ssl-load-extra-files key
    ssl-load-extra-del-ext
    ssl-default-bind-options ssl-min-ver TLSv1.2
    {{- end }}

defaults
    mode http
    log global
    option httplog
    timeout connect 1s
    timeout client 1h
    timeout server 1h

resolvers network
    parse-resolv-conf
    hold valid 1s

frontend grpc
    {{- if .Values.proxy.tlsSecret }}
    bind :50051 ssl crt /etc/nesam/tls/tls.crt alpn h2{{ if .Values.proxy.clientAuthoritySecret }} verify required ca-file /etc/nesam/client-authority/ca.crt{{ end }}
    {{- else }}
    bind :50051 proto h2
    {{- end }}
    http-request deny deny_status 400 unless { req.hdr(x-vehicle-id) -m found }
    default_backend replicas

backend replicas
    balance hdr(x-vehicle-id)
    hash-type consistent
    retries 3
    option redispatch 1
    option httpchk
    http-check connect port 50080 proto h1
    http-check send meth GET uri /health
    http-check expect status 200
    default-server proto h2 check inter 300ms fall 2 rise 1 on-marked-down shutdown-sessions init-addr last,libc,none resolvers network
    {{- $server := include "nesam.serverName" . }}
    {{- $tls := "" }}
    {{- if .Values.tls.secret }}
    {{- $tls = printf " ssl alpn h2 verify required ca-file /etc/nesam/authority/ca.crt sni str(%s) verifyhost %s" $server $server }}
    {{- end }}
    # Every proxy lists the replicas alike: all of them send a vehicle to the same one.
    {{- range $i := until (int .Values.replicas) }}
    server {{ $name }}-{{ $i }} {{ $name }}-{{ $i }}.{{ $name }}-replicas.{{ $.Release.Namespace }}.svc.{{ $.Values.clusterDomain }}:50051{{ $tls }}
    {{- end }}

# Probes and metrics of the proxy itself.
frontend own
    bind :8404
    option dontlog-normal
    monitor-uri /health
    http-request use-service prometheus-exporter if { path /metrics }
    http-request deny deny_status 404
{{- end }}
