{{/* Name of the release's things; short enough for the labels that a StatefulSet makes of it. */}}
{{- define "nesam.name" -}}
{{- if contains "nesam" .Release.Name }}{{ .Release.Name | trunc 40 | trimSuffix "-" }}{{ else }}{{ printf "%s-nesam" .Release.Name | trunc 40 | trimSuffix "-" }}{{ end }}
{{- end }}

{{/* What selects pods of the release; with a component those of one kind. */}}
{{- define "nesam.selector" -}}
app.kubernetes.io/name: nesam
app.kubernetes.io/instance: {{ .Release.Name }}
{{- end }}

{{- define "nesam.labels" -}}
{{ include "nesam.selector" . }}
app.kubernetes.io/version: {{ .Chart.AppVersion | quote }}
app.kubernetes.io/managed-by: {{ .Release.Service }}
helm.sh/chart: {{ printf "%s-%s" .Chart.Name .Chart.Version }}
{{- end }}

{{/* Name that the replicas' certificate has to have. */}}
{{- define "nesam.serverName" -}}
{{ .Values.tls.serverName | default (printf "%s-replicas.%s.svc" (include "nesam.name" .) .Release.Namespace) }}
{{- end }}

{{/* Of a container: nothing but what it needs. */}}
{{- define "nesam.containerSecurity" -}}
allowPrivilegeEscalation: false
readOnlyRootFilesystem: true
capabilities: {drop: [ALL]}
{{- end }}

{{/* What goes together. The rest is in values.schema.json. */}}
{{- define "nesam.check" -}}
{{- if not .Values.etcd.endpoints }}{{ fail "etcd.endpoints is empty: without etcd the replicas would not share their sessions" }}{{ end }}
{{- $secure := false }}
{{- range .Values.etcd.endpoints }}{{ if hasPrefix "https://" . }}{{ $secure = true }}{{ end }}{{ end }}
{{- if and $secure (not .Values.etcd.tlsSecret) }}{{ fail "etcd.endpoints has an https:// endpoint, which needs etcd.tlsSecret" }}{{ end }}
{{- if and .Values.etcd.tlsSecret (not $secure) }}{{ fail "etcd.tlsSecret is given and no endpoint of etcd.endpoints begins with https://" }}{{ end }}
{{- if and .Values.zenoh.enabled (not .Values.zenoh.listen) (not .Values.zenoh.connect) }}{{ fail "zenoh.enabled needs zenoh.connect or zenoh.listen" }}{{ end }}
{{- if regexMatch "(?m)^\\s*\\[+\\s*\"?(grpc|http|tls|zenoh|store|cluster)\\b" .Values.config }}{{ fail "config has one of the sections grpc, http, tls, zenoh, store and cluster, which this chart writes" }}{{ end }}
{{- if and .Values.proxy.clientAuthoritySecret (not .Values.proxy.tlsSecret) }}{{ fail "proxy.clientAuthoritySecret needs proxy.tlsSecret" }}{{ end }}
{{- end }}
