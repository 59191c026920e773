{{/* Refuses values that do not fit together; what one value may be is said by values.schema.json. */}}
{{- define "magic.check" -}}
{{- include "magic.checkNames" . -}}
{{- include "magic.checkConfig" . -}}
{{- $server := .Values.server -}}
{{- $database := .Values.database.secret -}}
{{- if and (gt (int $server.replicas) 1) (not (and $database .Values.bucket.url)) -}}
{{- fail (printf "server.replicas: %d servers share a PostgreSQL database and a bucket; give database.secret and bucket.url, or leave it at 1" (int $server.replicas)) -}}
{{- end -}}
{{- if and .Values.dask.enabled (not .Values.bucket.url) -}}
{{- fail "dask.enabled: workers share no folder with the servers, they read a bucket; give bucket.url" -}}
{{- end -}}
{{- if and .Values.gpuWorker.enabled (not .Values.dask.enabled) -}}
{{- fail "gpuWorker.enabled: workers serve a Dask scheduler; set dask.enabled as well" -}}
{{- end -}}
{{- if and .Values.dask.tls.secret (not .Values.dask.enabled) -}}
{{- fail "dask.tls.secret: there is no Dask without dask.enabled; set it as well" -}}
{{- end -}}
{{- if and (not .Values.bucket.url) (or .Values.bucket.endpoint .Values.bucket.region .Values.bucket.secret) -}}
{{- fail "bucket.url: endpoint, region and secret are of a bucket; give s3://BUCKET/PREFIX" -}}
{{- end -}}
{{- if and .Values.tls.clientCa (not .Values.tls.enabled) -}}
{{- fail "tls.clientCa: mutual TLS is TLS; set tls.enabled as well" -}}
{{- end -}}
{{- if and .Values.tokens.enabled (not .Values.tls.enabled) (not (dig "access" "insecure_tokens" false $server.config)) -}}
{{- fail "tokens.enabled: servers refuse tokens that come unencrypted; set tls.enabled, or tokens.enabled to false, or server.config.access.insecure_tokens to true in a network that nobody listens to" -}}
{{- end -}}
{{- if and $database (ne $server.service.type "ClusterIP") -}}
{{- fail (printf "server.service.type: %s would lead each call to any server, but clients follow their session to one; with database.secret leave ClusterIP and set server.servicePerReplica.enabled" $server.service.type) -}}
{{- end -}}
{{- if and $server.service.sourceRanges (ne $server.service.type "LoadBalancer") -}}
{{- fail "server.service.sourceRanges: only a load balancer knows them; set server.service.type to LoadBalancer, or use networkPolicy.callers" -}}
{{- end -}}
{{- if and $server.storage.existingClaim (gt (int $server.replicas) 1) -}}
{{- fail "server.storage.existingClaim: each server has a volume of its own; leave it empty, or server.replicas at 1" -}}
{{- end -}}
{{- if and $server.address (not $database) -}}
{{- fail "server.address: one server on SQLite names itself to nobody; leave it empty, or give database.secret" -}}
{{- end -}}
{{- if and $server.address (gt (int $server.replicas) 1) (not (contains "$(POD)" $server.address)) -}}
{{- fail (printf "server.address: %s is the same for %d servers; write $(POD) where the server's name belongs" $server.address (int $server.replicas)) -}}
{{- end -}}
{{- if $server.servicePerReplica.enabled -}}
{{- if not $database -}}
{{- fail "server.servicePerReplica.enabled: it is for several servers on database.secret; for one use server.service.type" -}}
{{- end -}}
{{- if not $server.address -}}
{{- fail "server.address: clients from outside would be sent to names inside the cluster; with server.servicePerReplica give for instance $(POD).maps.example:50051" -}}
{{- end -}}
{{- end -}}
{{- if and .Values.worker.autoscaling.enabled (gt (int .Values.worker.autoscaling.minReplicas) (int .Values.worker.autoscaling.maxReplicas)) -}}
{{- fail (printf "worker.autoscaling: minReplicas %d is above maxReplicas %d" (int .Values.worker.autoscaling.minReplicas) (int .Values.worker.autoscaling.maxReplicas)) -}}
{{- end -}}
{{- end -}}

{{/* Kubernetes wants names of services to be DNS labels, and a server's name has at most 31 characters. */}}
{{- define "magic.checkNames" -}}
{{- $name := include "magic.fullname" . -}}
{{- if not (regexMatch "^[a-z]([-a-z0-9]*[a-z0-9])?$" $name) -}}
{{- fail (printf "fullnameOverride: %q begins the names of services, of small letters, digits and -, a letter first; give one" $name) -}}
{{- end -}}
{{- $longest := printf "%s-server-%d" $name (sub (int .Values.server.replicas) 1) -}}
{{- if and .Values.database.secret (gt (len $longest) 31) -}}
{{- fail (printf "fullnameOverride: %q makes servers of the name %s, %d characters, and 31 is the most; give a shorter one" $name $longest (len $longest)) -}}
{{- end -}}
{{- if gt (len $name) 40 -}}
{{- fail (printf "fullnameOverride: %q has %d characters, and 40 is the most; give a shorter one" $name (len $name)) -}}
{{- end -}}
{{- end -}}

{{/* What the chart writes into the config, and which value says it. */}}
{{- define "magic.checkConfig" -}}
{{- $instead := dict
  "data_dir" "server.storage"
  "store.database" "database.secret"
  "store.database_file" "database.secret"
  "store.database_env" "database.secret"
  "store.index" "database.pgvector"
  "store.blobs" "bucket.url"
  "store.s3_endpoint" "bucket.endpoint"
  "store.s3_region" "bucket.region"
  "store.blob_cache_bytes" "bucket.cacheBytes"
  "cluster.replica" "server.replicas"
  "cluster.address" "server.address"
  "listen.host" "server.service"
  "listen.port" "server.service"
  "listen.insecure" "tls.enabled"
  "listen.stop_grace_s" "server.stopGraceSeconds"
  "tls" "tls"
  "access.tokens_file" "tokens.secret"
  "metrics" "metrics"
  "health" "metrics"
  "jobs.executor" "dask.enabled"
  "jobs.scheduler" "dask.enabled"
  "jobs.merge_resources" "gpuWorker.enabled"
  "jobs.tls" "dask.tls.secret"
-}}
{{- $config := .Values.server.config -}}
{{- range $setting, $value := $instead -}}
{{- $parts := splitList "." $setting -}}
{{- $section := index $parts 0 -}}
{{- if hasKey $config $section -}}
{{- $inner := get $config $section -}}
{{- if or (eq (len $parts) 1) (and (kindIs "map" $inner) (hasKey $inner (last $parts))) -}}
{{- fail (printf "server.config.%s: the chart writes it; use the value %s" $setting $value) -}}
{{- end -}}
{{- end -}}
{{- end -}}
{{- end -}}
