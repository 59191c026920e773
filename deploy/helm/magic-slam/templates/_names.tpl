{{/* Names and labels. */}}

{{- define "magic.fullname" -}}
{{- default .Release.Name .Values.fullnameOverride -}}
{{- end -}}

{{/* Labels that choose the pods of a component: (list $ "server"). */}}
{{- define "magic.selector" -}}
{{- $root := index . 0 -}}
app.kubernetes.io/name: {{ $root.Chart.Name }}
app.kubernetes.io/instance: {{ $root.Release.Name | quote }}
app.kubernetes.io/component: {{ index . 1 }}
{{- end -}}

{{/* Labels of an object. */}}
{{- define "magic.labels" -}}
{{- $root := index . 0 -}}
{{ include "magic.selector" . }}
app.kubernetes.io/version: {{ $root.Chart.AppVersion | quote }}
app.kubernetes.io/managed-by: {{ $root.Release.Service }}
helm.sh/chart: {{ printf "%s-%s" $root.Chart.Name $root.Chart.Version | replace "+" "_" }}
{{- end -}}

{{/* Labels of a component's pods. */}}
{{- define "magic.podLabels" -}}
{{- $root := index . 0 -}}
{{- $part := index $root.Values (index . 2) -}}
{{- with $part.podLabels }}{{ toYaml . }}
{{ end -}}
{{ include "magic.selector" . }}
{{- end -}}

{{/* The image of a set of values: (list $ .Values.image). */}}
{{- define "magic.image" -}}
{{- $root := index . 0 -}}
{{- $image := index . 1 -}}
{{- if $image.digest -}}
{{ $image.repository }}@{{ $image.digest }}
{{- else -}}
{{ $image.repository }}:{{ default $root.Chart.AppVersion $image.tag }}
{{- end -}}
{{- end -}}

{{- define "magic.serviceAccount" -}}
{{- if .Values.serviceAccount.create -}}
{{ default (include "magic.fullname" .) .Values.serviceAccount.name }}
{{- else -}}
{{ .Values.serviceAccount.name }}
{{- end -}}
{{- end -}}

{{/* Where Dask's scheduler listens. */}}
{{- define "magic.scheduler" -}}
{{ ternary "tls" "tcp" (ne .Values.dask.tls.secret "") }}://{{ include "magic.fullname" . }}-scheduler.{{ .Release.Namespace }}.svc:8786
{{- end -}}

{{/* What clients dial to reach a server; $(POD) stands for its name. */}}
{{- define "magic.address" -}}
{{- $service := printf "%s-server.%s.svc:50051" (include "magic.fullname" .) .Release.Namespace -}}
{{- if not .Values.database.secret -}}
{{ $service }}
{{- else -}}
{{ default (printf "$(POD).%s" $service) .Values.server.address }}
{{- end -}}
{{- end -}}
