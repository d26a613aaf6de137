-- A segment's header in its fixed layout, as the chain hashes it (docs/reference/segment.md).
-- Numbers are big-endian, texts are UTF-8 behind a two-byte length.
create function segment_header(
  p_epoch integer, p_station text, p_source text, p_type text, p_first_sequence bigint, p_event_count integer,
  p_schema_version integer, p_time_min timestamptz, p_time_max timestamptz, p_producer text, p_version text,
  p_configuration bytea
) returns bytea language sql immutable strict set search_path from current as $$
  select 'VIANSEG1'::bytea
    || int4send(p_epoch) || header_text(p_station) || header_text(p_source) || header_text(p_type)
    || int8send(p_first_sequence) || int4send(p_event_count) || int4send(p_schema_version)
    || int8send((extract(epoch from p_time_min) * 1000000)::bigint)
    || int8send((extract(epoch from p_time_max) * 1000000)::bigint)
    || header_text(p_producer) || header_text(p_version) || p_configuration
$$;
