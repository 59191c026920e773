{{/* What all pods have in common. */}}

{{/* The settings of a pod: (list $ "worker"), the values' name. */}}
{{- define "magic.pod" -}}
{{- $root := index . 0 -}}
{{- $part := index $root.Values (index . 1) -}}
automountServiceAccountToken: false
# No variables for the services of the namespace: Dask takes every DASK_* for a setting.
enableServiceLinks: false
{{- with include "magic.serviceAccount" $root }}
serviceAccountName: {{ quote . }}
{{- end }}
{{- with $root.Values.image.pullSecrets }}
imagePullSecrets:
  {{- range . }}
  - name: {{ quote . }}
  {{- end }}
{{- end }}
{{- with $part.priorityClassName }}
priorityClassName: {{ quote . }}
{{- end }}
{{- with $part.nodeSelector }}
nodeSelector: {{- toYaml . | nindent 2 }}
{{- end }}
{{- with $part.tolerations }}
tolerations: {{- toYaml . | nindent 2 }}
{{- end }}
{{- with $part.affinity }}
affinity: {{- toYaml . | nindent 2 }}
{{- end }}
{{- end -}}

{{/* The settings of a container. */}}
{{- define "magic.container" -}}
{{- $root := index . 0 -}}
{{- $part := index $root.Values (index . 1) -}}
imagePullPolicy: {{ $root.Values.image.pullPolicy }}
resources: {{- toYaml $part.resources | nindent 2 }}
securityContext: {{- toYaml $root.Values.containerSecurityContext | nindent 2 }}
{{- end -}}

{{/* The bucket's credentials. */}}
{{- define "magic.credentials" -}}
{{- with .Values.bucket.secret -}}
envFrom:
  - secretRef:
      name: {{ quote . }}
{{- end }}
{{- end -}}

{{- define "magic.daskTlsMount" -}}
{{- if .Values.dask.tls.secret -}}
- name: dask-tls
  mountPath: /etc/magic-dask-tls
  readOnly: true
{{- end }}
{{- end -}}

{{- define "magic.daskTlsVolume" -}}
{{- with .Values.dask.tls.secret -}}
- name: dask-tls
  secret:
    secretName: {{ quote . }}
    defaultMode: 0440
{{- end }}
{{- end -}}
