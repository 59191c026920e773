{{/* The servers' config: what the chart makes, and server.config over it. */}}
{{- define "magic.config" -}}
{{- $own := include "magic.ownConfig" . | fromYaml -}}
{{- mustMergeOverwrite $own (deepCopy .Values.server.config) | toYaml -}}
{{- end -}}

{{- define "magic.ownConfig" -}}
data_dir: /data/store
{{- if or .Values.database.secret .Values.bucket.url }}
store:
  {{- if and .Values.database.secret .Values.database.pgvector }}
  index: pgvector
  {{- end }}
  {{- with .Values.bucket }}
  {{- if .url }}
  blobs: {{ quote .url }}
  blob_cache_bytes: {{ int64 .cacheBytes }}
  {{- if .endpoint }}
  s3_endpoint: {{ quote .endpoint }}
  {{- end }}
  {{- if .region }}
  s3_region: {{ quote .region }}
  {{- end }}
  {{- end }}
  {{- end }}
{{- end }}
{{- if .Values.dask.enabled }}
jobs:
  executor: dask
  scheduler: {{ include "magic.scheduler" . }}
  {{- if .Values.gpuWorker.enabled }}
  merge_resources: gpu=1
  {{- end }}
  {{- if .Values.dask.tls.secret }}
  tls:
    ca: /etc/magic-dask-tls/ca.crt
    certificate: /etc/magic-dask-tls/tls.crt
    key: /etc/magic-dask-tls/tls.key
  {{- end }}
{{- end }}
listen:
  host: 0.0.0.0
  port: 50051
  stop_grace_s: {{ .Values.server.stopGraceSeconds }}
  {{- if not .Values.tls.enabled }}
  insecure: true
  {{- end }}
{{- if .Values.tls.enabled }}
tls:
  certificate: /etc/magic-tls/tls.crt
  key: /etc/magic-tls/tls.key
  {{- if .Values.tls.clientCa }}
  client_ca: /etc/magic-tls/ca.crt
  {{- end }}
{{- end }}
{{- if .Values.tokens.enabled }}
access:
  tokens_file: /etc/magic-tokens/tokens
{{- end }}
metrics:
  host: 0.0.0.0
  port: 9464
health:
  # The kubelet's gRPC probes speak no TLS: a port that answers health and nothing else.
  host: 0.0.0.0
  port: 50052
logs:
  format: json
{{- end -}}
