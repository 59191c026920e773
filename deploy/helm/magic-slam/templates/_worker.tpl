{{/* A deployment of workers: (list $ "worker-gpu" "gpuWorker" IMAGE OPTION), component, values, what it offers. */}}
{{- define "magic.worker" -}}
{{- $root := index . 0 -}}
{{- $component := index . 1 -}}
{{- $values := index . 2 -}}
{{- $part := index $root.Values $values -}}
apiVersion: apps/v1
kind: Deployment
metadata:
  name: {{ include "magic.fullname" $root }}-{{ $component }}
  labels: {{- include "magic.labels" (list $root $component) | nindent 4 }}
spec:
  {{- if not (dig "autoscaling" "enabled" false $part) }}
  replicas: {{ $part.replicas }}
  {{- end }}
  selector:
    matchLabels: {{- include "magic.selector" (list $root $component) | nindent 6 }}
  template:
    metadata:
      labels: {{- include "magic.podLabels" (list $root $component $values) | nindent 8 }}
      {{- with $part.podAnnotations }}
      annotations: {{- toYaml . | nindent 8 }}
      {{- end }}
    spec:
      {{- include "magic.pod" (list $root $values) | nindent 6 }}
      {{- with $part.runtimeClassName }}
      runtimeClassName: {{ quote . }}
      {{- end }}
      securityContext: {{- toYaml $root.Values.podSecurityContext | nindent 8 }}
      containers:
        - name: worker
          image: {{ include "magic.image" (list $root (index . 3)) | quote }}
          {{- include "magic.container" (list $root $values) | nindent 10 }}
          args:
            - worker
            - {{ include "magic.scheduler" $root }}
            - {{ index . 4 }}
            - --data-dir=/work
            {{- if $root.Values.dask.tls.secret }}
            - --tls.ca=/etc/magic-dask-tls/ca.crt
            - --tls.certificate=/etc/magic-dask-tls/tls.crt
            - --tls.key=/etc/magic-dask-tls/tls.key
            {{- end }}
            {{- range $part.args }}
            - {{ quote . }}
            {{- end }}
          {{- with include "magic.credentials" $root }}{{ nindent 10 . }}{{ end }}
          env:
            - name: MAGIC_KERNEL_CACHE
              value: /work/kernels
            {{- with $part.env }}
            {{- toYaml . | nindent 12 }}
            {{- end }}
          volumeMounts:
            - name: work
              mountPath: /work
            {{- with include "magic.daskTlsMount" $root }}{{ nindent 12 . }}{{ end }}
            - name: tmp
              mountPath: /tmp
            {{- with $part.extraVolumeMounts }}
            {{- toYaml . | nindent 12 }}
            {{- end }}
      volumes:
        # What jobs read and make, store.blob_cache_bytes among it: gone with the pod.
        - name: work
          emptyDir:
            sizeLimit: {{ quote $part.scratch }}
        {{- with include "magic.daskTlsVolume" $root }}{{ nindent 8 . }}{{ end }}
        - name: tmp
          emptyDir: {}
        {{- with $part.extraVolumes }}
        {{- toYaml . | nindent 8 }}
        {{- end }}
{{- end -}}
